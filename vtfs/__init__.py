"""Which many-light technique, and which parameters, are right for your scene on your device.

Public names, in the order in which data flows; loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import Any

_PUBLIC = {
    "Scene": "vtfs.scene",
    "Material": "vtfs.scene",
    "load_scene": "vtfs.scene",
    "save_scene": "vtfs.scene",
    "build_scene": "vtfs.gallery",
    "Camera": "vtfs.camera",
    "CameraPath": "vtfs.camera",
    "Viewport": "vtfs.camera",
    "load_cameras": "vtfs.camera",
    "Lights": "vtfs.lights",
    "load_lights": "vtfs.lights",
    "scatter_lights": "vtfs.lights",
    "ViewSamples": "vtfs.view_samples",
    "trace_view_samples": "vtfs.view_samples",
    "load_gbuffer": "vtfs.gbuffer_files",
    "save_gbuffer": "vtfs.gbuffer_files",
    "Configuration": "vtfs.configurations",
    "configuration": "vtfs.configurations",
    "FrameInputs": "vtfs.frame_inputs",
    "count": "vtfs.frame_counts",
    "render": "vtfs.frame",
    "relaxed_frame": "vtfs.relaxed_frame",
    "count_variables": "vtfs.relaxed_frame",
    "candidate_pairs": "vtfs.relaxed_frame",
    "expected_lighting_computations": "vtfs.relaxed_counts",
    "forward_reference": "vtfs.reference",
    "image_error": "vtfs.reference",
    "InputError": "vtfs.input_error",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)
