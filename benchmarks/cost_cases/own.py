from collections.abc import Iterator


def rows(*_) -> Iterator[tuple[str, str, str]]:
    yield from ()
