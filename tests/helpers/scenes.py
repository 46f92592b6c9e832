"""Comparison of scene directories."""


def same_files(a, b):
    """Assert that two directories hold the same files with the same bytes."""
    names = sorted(p.relative_to(a) for p in a.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(b) for p in b.rglob("*") if p.is_file())
    for name in names:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def names_in(folder):
    """Names of what is in a directory, sorted."""
    return sorted(path.name for path in folder.iterdir())
