"""The commands of `lagros`, a file each."""
