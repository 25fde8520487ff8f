"""`vtfs scenes`, `vtfs techniques`, `vtfs doctor`: what there is, and what this machine can do."""

from __future__ import annotations

from vtfs.parameters import PARAMETERS, TECHNIQUES
from vtfs.technique_names import TECHNIQUE_GROUPS


def scenes() -> None:
    """The built-in scenes."""
    from rich.console import Console
    from rich.table import Table

    from vtfs.gallery import GALLERY

    table = Table("scene", "triangles", "what it is", box=None, pad_edge=False)
    for name, builtin in GALLERY.items():
        table.add_row(name, f"{builtin.default_triangles:,}", builtin.description)
    Console().print(table)


def techniques() -> None:
    """The techniques, groups of them, and their parameters."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table("technique", "parameters", box=None, pad_edge=False)
    for name, names in TECHNIQUES.items():
        table.add_row(name, ", ".join(names))
    console.print(table)
    table = Table("group", "techniques, wherever several can be named", box=None, pad_edge=False)
    for name, members in TECHNIQUE_GROUPS.items():
        table.add_row(name, ", ".join(members))
    console.print()
    console.print(table)
    table = Table("parameter", "default", "values", "meaning", box=None, pad_edge=False)
    for parameter in PARAMETERS.values():
        table.add_row(parameter.name, str(parameter.default), parameter.allowed, parameter.meaning)
    console.print()
    console.print(table)


def doctor() -> None:
    """What this machine can do: devices, versions, caches."""
    import jax

    from vtfs.cache import cache_dir
    from vtfs.device import device_name, versions

    print(f"device    {device_name()}")
    print(f"others    {', '.join(str(d) for d in jax.devices()[1:]) or 'none'}")
    for name, version in versions().items():
        print(f"{name:9s} {version}")
    try:
        import embreex  # noqa: F401

        print("embree    found")
    except ImportError as error:
        print(f"embree    missing ({error}): view samples cannot be traced, only read from .npz")
    folder = cache_dir()
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.exists() else 0
    print(f"cache     {folder} ({size / 1e6:.0f} MB; VTFS_CACHE_DIR moves it)")
