"""`CapturedCosts`: costs of candidates as CUDA graphs, which a GPU replays without the calls of single kernels.

Shapes: B environments, S candidates, H model steps, A the dimension of a model step.
"""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

__all__ = ["CapturedCosts"]

#: A function from infos and candidates `(B, S, H, A)` to costs `(B, S)`.
Cost = Callable[[dict[str, Any], Tensor], Tensor]

#: The largest number of graphs of a model; the one that was not used for the longest time goes first.
_GRAPHS = 8


class CapturedCosts:
    """The costs of a model with `prepare_plan`: for each shape of its infos and candidates, `get_cost` is recorded once."""

    def __init__(self) -> None:
        self._graphs: OrderedDict[Any, _Graph] = OrderedDict()
        #: The infos and the shape of the candidates of the last call, and their graph.
        self._last: tuple[Any, torch.Size, _Graph] | None = None
        self._refused = False

    @classmethod
    def of(cls, model: Any) -> CapturedCosts:
        """The recorded costs of a model, which live as long as the model."""
        return _OF_MODELS.setdefault(model, cls())

    def __call__(self, model: Any, infos: dict[str, Any], candidates: Tensor, cost: Cost) -> Tensor:
        """The costs `(B, S)` of candidates `(B, S, H, A)`, which the next call overwrites.

        Args:
            model: The model, on an NVIDIA GPU, with `get_cost` and `prepare_plan`; see `stable_worldmodel.wm.LeWM`.
            infos: The infos of an observation, to which this adds the results of `prepare_plan`.
            candidates: The candidates.
            cost: Computes the costs of candidates; it is called only to record a graph, or if that fails.
        """
        last = self._last
        if last is None or last[0] is not infos or last[1] != candidates.shape:
            model.prepare_plan(infos, candidates.shape[1])
            graph = None if self._refused else self._graph(model, infos, candidates, cost)
            if graph is None:
                return cost(infos, candidates)
            last = self._last = (infos, candidates.shape, graph)
        return last[2].replay(candidates)

    def _graph(self, model: Any, infos: dict[str, Any], candidates: Tensor, cost: Cost) -> _Graph | None:
        """The graph for the shapes of these infos and candidates, with the values of the infos; `None` if there is none."""
        inputs = {name: value for name, value in infos.items() if torch.is_tensor(value)}
        key = (_form(candidates), *((name, *_form(value)) for name, value in sorted(inputs.items())), *_state(model))
        graph = self._graphs.get(key)
        if graph is None:
            try:
                graph = self._graphs[key] = _Graph(inputs, candidates, cost)
            except RuntimeError as error:
                self._refused = True
                name, reason = type(model).__name__, str(error).splitlines()[0]
                warnings.warn(
                    f"{name}.get_cost cannot be recorded as a CUDA graph ({reason}); plans call every kernel, which is "
                    f"slower. Set prepare_plan = None in {name} if that is intended",
                    stacklevel=2,
                )
                return None
            if len(self._graphs) > _GRAPHS:
                self._graphs.popitem(last=False)
        else:
            graph.load(inputs)
        self._graphs.move_to_end(key)
        return graph


#: The recorded costs of each model.
_OF_MODELS: WeakKeyDictionary[Any, CapturedCosts] = WeakKeyDictionary()


class _Graph:
    """The recorded costs of candidates of one shape."""

    def __init__(self, inputs: dict[str, Tensor], candidates: Tensor, cost: Cost) -> None:
        self.inputs = {name: _own(value) for name, value in inputs.items()}
        self.candidates = candidates.clone()
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        # Libraries choose kernels and reserve memory at their first calls, which cannot be recorded.
        with torch.cuda.stream(stream), _without_cached_casts():
            for _ in range(2):
                cost(dict(self.inputs), self.candidates)
        torch.cuda.current_stream().wait_stream(stream)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph), _without_cached_casts():
            self.costs = cost(dict(self.inputs), self.candidates)

    def load(self, inputs: dict[str, Tensor]) -> None:
        """Replaces the values of the infos."""
        for name, value in inputs.items():
            _stored(self.inputs[name]).copy_(_stored(value))

    def replay(self, candidates: Tensor) -> Tensor:
        """The costs of candidates."""
        self.candidates.copy_(candidates)
        self.graph.replay()
        return self.costs


def _state(model: Any) -> tuple[Any, ...]:
    """What a graph depends on, apart from the values of its inputs: the places of the weights, and modes of torch."""
    parts = [*model.parameters(), *model.buffers()]
    modes = torch.get_float32_matmul_precision(), torch.is_autocast_enabled("cuda"), torch.get_autocast_dtype("cuda")
    return (hash(tuple(part.data_ptr() for part in parts)), model.training, *modes)


def _without_cached_casts() -> Any:
    """The current autocast, without the casted weights that it keeps until it ends: a graph would outlive them."""
    enabled, kind = torch.is_autocast_enabled("cuda"), torch.get_autocast_dtype("cuda")
    return torch.autocast("cuda", kind, enabled=enabled, cache_enabled=False)


def _form(value: Tensor) -> tuple[Any, ...]:
    """Shape, type, and which axes are repeated rather than stored."""
    return (value.shape, value.dtype, value.device, tuple(stride == 0 for stride in value.stride()))


def _stored(value: Tensor) -> Tensor:
    """One element of every axis that is repeated rather than stored."""
    return value[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in value.stride())]


def _own(value: Tensor) -> Tensor:
    """A copy with the same repeated axes."""
    return _stored(value).clone(memory_format=torch.contiguous_format).expand(value.shape)
