"""Progress of long runs in terminals and notebooks: a tqdm bar, or lines in a terminal if tqdm is not installed."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def bar(what: str, total: int, shown: bool) -> Iterator[Callable[[int, int, int], None] | None]:
    """Yields a progress callback `(done, total, steps)`, or `None` without a display."""
    if not shown:
        yield None
        return
    try:
        from tqdm.auto import tqdm
    except ImportError:
        yield _lines(what)
        return
    with tqdm(total=total, desc=what, unit="episode", disable=None if sys.stderr.isatty() else not _notebook()) as shown_bar:
        begun = time.monotonic()

        def report(done: int, total: int, steps: int) -> None:
            shown_bar.total = total
            shown_bar.set_postfix_str(f"{steps / max(time.monotonic() - begun, 1e-9):.0f} steps/s", refresh=False)
            shown_bar.update(done - shown_bar.n)

        yield report


def _notebook() -> bool:
    """Whether this is a notebook."""
    return "ipykernel" in sys.modules


def _lines(what: str) -> Callable[[int, int, int], None] | None:
    if not sys.stderr.isatty():
        return None
    last = time.monotonic()

    def report(done: int, total: int, steps: int) -> None:
        nonlocal last
        if done == total or time.monotonic() - last > 5:
            last = time.monotonic()
            print(f"{what}: {done} of {total} episodes, {steps} steps", file=sys.stderr)

    return report
