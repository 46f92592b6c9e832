"""Tools without a subject of their own: files, processes, storage, compiling, the console."""
