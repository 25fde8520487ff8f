"""How many programs were compiled, and how long that took: the cost of a sweep that nobody sees."""

from __future__ import annotations

from dataclasses import dataclass

import jax

_COMPILED = "/jax/core/compile/backend_compile_duration"
_CACHE_HIT = "/jax/compilation_cache/cache_hits"


@dataclass
class Compiles:
    """Backend compile events, eager operations included, less those that the cache on disk answered.

    - `seconds`: spent in the backend's compiler or in reading its cache.
    """

    events: int = 0
    cache_hits: int = 0
    seconds: float = 0.0

    @property
    def programs(self) -> int:
        return self.events - self.cache_hits

    def copy(self) -> Compiles:
        return Compiles(self.events, self.cache_hits, self.seconds)


def watch_compiles() -> Compiles:
    """A record that counts from now on, for as long as the process lives."""
    seen = Compiles()

    def on_duration(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == _COMPILED:
            seen.events += 1
            seen.seconds += duration_secs

    def on_event(event: str, **kwargs: str | int) -> None:
        if event == _CACHE_HIT:
            seen.cache_hits += 1

    jax.monitoring.register_event_duration_secs_listener(on_duration)
    jax.monitoring.register_event_listener(on_event)
    return seen
