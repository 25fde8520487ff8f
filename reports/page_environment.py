"""The templates of the pages, and what they may call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2

from reports import number_text
from reports.palette import in_stage_order, technique_colour
from reports.recommendation import comparison, setting_text


def page_environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    texts: dict[str, Any] = {
        "ms": number_text.ms,
        "seconds": number_text.seconds,
        "ratio": number_text.ratio,
        "count": number_text.count,
        "percent": number_text.percent,
        "error": number_text.error,
        "cost": number_text.cost,
        "setting": number_text.setting,
    }
    environment.filters.update(texts)
    environment.globals.update(
        comparison=comparison,
        in_stage_order=in_stage_order,
        interval=number_text.interval,
        ratios=number_text.ratios,
        setting_text=setting_text,
        technique_colour=technique_colour,
    )
    return environment
