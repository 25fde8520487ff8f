from pathlib import Path


def write_stability_page(folder):
    return Path(folder) / "x"
