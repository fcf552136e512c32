"""Collation without a copy.

A torch `DataLoader` requests the samples of a batch in one call and then stacks them. The samples of this package are
views of one array, so the default collation returns that array.
"""

from __future__ import annotations

import sys
from typing import Any


class Batch:
    """A batch that was read in one call: the columns `(B, ...)`, and a view of each column for each sample."""

    __slots__ = ("columns", "size", "views")

    def __init__(self, columns: dict[str, Any], size: int) -> None:
        self.columns = columns
        self.size = size
        self.views = {name: [column[i] for i in range(size)] for name, column in columns.items()}

    def samples(self) -> list[dict[str, Any]]:
        """Returns one dict for each sample."""
        return [Sample(self, i) for i in range(self.size)]


class Sample(dict[str, Any]):
    """A sample of a batch that was read in one call: a dict with a reference to that batch."""

    __slots__ = ("index", "batch")

    def __init__(self, batch: Batch, index: int) -> None:
        super().__init__((name, views[index]) for name, views in batch.views.items())
        self.batch = batch
        self.index = index

    def __reduce__(self) -> Any:
        return (dict, (dict(self),))

    def untouched(self) -> bool:
        """Whether the sample still holds the views of its batch."""
        views = self.batch.views
        return len(self) == len(views) and all(self.get(name) is view[self.index] for name, view in views.items())


def collate(samples: list[Any], *, collate_fn_map: Any = None) -> Any:
    """Collates samples. All samples of one `Batch`, unchanged and in order, become the columns of that batch."""
    from torch.utils.data._utils.collate import collate as torch_collate

    batch = samples[0].batch
    is_complete = len(samples) == batch.size and all(
        isinstance(sample, Sample) and sample.batch is batch and sample.index == i and sample.untouched()
        for i, sample in enumerate(samples)
    )
    if is_complete:
        return dict(batch.columns)
    return torch_collate([dict(sample) for sample in samples], collate_fn_map=collate_fn_map)


def install() -> None:
    """Registers `collate` in torch's default collation, if torch is imported."""
    module = sys.modules.get("torch.utils.data._utils.collate")
    if module is not None:
        module.default_collate_fn_map.setdefault(Sample, collate)
