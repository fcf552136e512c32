"""Samples that were read together, put together again without a copy.

A torch `DataLoader` asks a dataset for the samples of a batch at once, and then stacks them. Ours were views of one
array all along, so what its default collation gets is that array.
"""

from __future__ import annotations

import sys
from typing import Any


class Together:
    """A batch that was read at once: its columns `(batch, ...)`, and the samples' views of them."""

    __slots__ = ("columns", "size", "views")

    def __init__(self, columns: dict[str, Any], size: int) -> None:
        self.columns = columns
        self.size = size
        self.views = {name: [column[i] for i in range(size)] for name, column in columns.items()}

    def samples(self) -> list[dict[str, Any]]:
        """A dict a sample."""
        return [Sample(self, i) for i in range(self.size)]


class Sample(dict[str, Any]):
    """A sample of a batch that was read at once: a dict, which remembers where it comes from."""

    __slots__ = ("place", "together")

    def __init__(self, together: Together, place: int) -> None:
        super().__init__((name, views[place]) for name, views in together.views.items())
        self.together = together
        self.place = place

    def __reduce__(self) -> Any:
        return (dict, (dict(self),))

    def untouched(self) -> bool:
        """Whether it is still what was read."""
        views = self.together.views
        return len(self) == len(views) and all(self.get(name) is view[self.place] for name, view in views.items())


def collate(samples: list[Any], *, collate_fn_map: Any = None) -> Any:
    """Samples as a batch: that which they were read in, if they are all of it and as they were."""
    from torch.utils.data._utils.collate import collate as torch_collate

    together = samples[0].together
    whole = len(samples) == together.size and all(
        isinstance(sample, Sample) and sample.together is together and sample.place == i and sample.untouched()
        for i, sample in enumerate(samples)
    )
    if whole:
        return dict(together.columns)
    return torch_collate([dict(sample) for sample in samples], collate_fn_map=collate_fn_map)


def install() -> None:
    """Tells torch's default collation about our samples, if torch is there."""
    module = sys.modules.get("torch.utils.data._utils.collate")
    if module is not None:
        module.default_collate_fn_map.setdefault(Sample, collate)
