"""The commands of `lagros`, a file each.

Here only the standard library, typer and this package are imported with a module; what a command
needs is imported inside it, so that `lagros --help` answers at once.
"""
