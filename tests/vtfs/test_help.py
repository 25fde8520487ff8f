"""The command line as a new user meets it: help, and what there is."""

import importlib.metadata
import os
import subprocess
import sys

import pytest

from tests.command_line import ROOT, vtfs
from vtfs.gallery import GALLERY
from vtfs.parameters import PARAMETERS, TECHNIQUES
from vtfs.technique_names import TECHNIQUE_GROUPS

COMMANDS = ("tune", "count", "render", "stability", "report", "scenes", "techniques", "doctor")


def test_help_needs_nothing_heavy():
    """Importing jax alone takes 0.8 s, and help must answer in one."""
    heavy = ("jax", "numpy", "scipy", "trimesh", "plotly", "jinja2", "equinox", "PIL")
    program = f"""
import sys
from vtfs.cli import main
sys.argv = ["vtfs", "--help"]
try:
    main()
except SystemExit as left:
    assert left.code == 0, left.code
print("loaded:", *[name for name in {heavy} if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.splitlines()[-1] == "loaded:", run.stdout[-300:] + run.stderr
    assert all(command in run.stdout for command in COMMANDS) and run.stderr == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    ran = vtfs(command, "--help")
    assert ran.code == 0 and f"vtfs {command}" in ran.out and ran.err == ""


def test_without_a_command_there_is_help():
    assert vtfs() == vtfs("--help") == vtfs("-h")
    assert vtfs().code == 0


def test_the_version_is_the_packages():
    assert vtfs("--version").out == f"vtfs {importlib.metadata.version('vtfs')}\n"


def test_scenes_and_techniques_list_everything_there_is():
    scenes, techniques = vtfs("scenes"), vtfs("techniques")
    assert scenes.code == techniques.code == 0 and scenes.err == techniques.err == ""
    assert all(name in scenes.out for name in GALLERY)
    assert all(name in techniques.out for name in (*TECHNIQUES, *TECHNIQUE_GROUPS, *PARAMETERS))


def test_doctor_names_the_device_the_versions_and_the_cache():
    ran = vtfs("doctor")
    assert ran.code == 0 and ran.err == ""
    for word in ("device", "jax", "numpy", "embree    found", os.environ["VTFS_CACHE_DIR"]):
        assert word in ran.out
