"""A report in one page for a browser: the table, its figures, and episodes to play.

Whatever it needs stands in it, so that it opens from a disk or a mail, without a network.
"""
