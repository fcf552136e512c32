"""`ExpertPolicy`: acts with a policy that Stable-Baselines3 trained with SAC.

The files are read as data: weights without pickled objects, and statistics with an unpickler that creates arrays of numbers and
plain records only, and calls nothing of another package. Stable-Baselines3 is not needed.
"""

from __future__ import annotations

import json
import os
import pickle
import re
import struct
import zipfile
from typing import Any

import numpy as np

from ...policy import BasePolicy

__all__ = ["ExpertPolicy", "SB3Normalizer"]

#: The largest file of statistics, in bytes.
_MOST_STATISTICS = 16 << 20
#: The largest settings of a model, in bytes.
_MOST_SETTINGS = 64 << 20

#: The activations of the hidden layers that are known.
_ACTIVATIONS = ("ELU", "GELU", "LeakyReLU", "ReLU", "SiLU", "Tanh")


class _Record:
    """An object of a pickle file whose class is not imported."""

    def __init__(self, *args: Any, **kwargs: Any) -> None: ...

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class _Number:
    """A data type of a pickle file.

    Arrays of other types than numbers are read as empty, because flags of a type of objects could turn bytes into pointers.
    """

    def __init__(self, code: Any, *args: Any) -> None:
        # Nested lists of a small file can have a text that fills the memory.
        if not isinstance(code, str):
            raise pickle.UnpicklingError("a data type without a name")
        self.code, self.order = code, "="

    def __setstate__(self, state: Any) -> None:
        self.order = {"<": "<", ">": ">"}.get(state[1], "=")

    def read(self, data: Any) -> np.ndarray:
        if re.fullmatch("b1|[iu][1248]|f[248]", self.code) is None:
            return np.zeros(0)
        return np.frombuffer(data, np.dtype(self.order + self.code))


class _Array(_Record):
    """An array of a pickle file."""

    value: np.ndarray

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, by_columns, data = state
        self.value = _shaped(data, kind, shape, "F" if by_columns else "C")


def _shaped(data: Any, kind: _Number, shape: Any, order: str) -> np.ndarray:
    values = kind.read(data)
    return values.reshape(shape, order="F" if order == "F" else "C") if values.size else values


#: What reads numbers and arrays in place of numpy's functions, by the names of those; every other name is a record.
_READERS: dict[tuple[str, str], Any] = {("numpy", "dtype"): _Number}
for _core in ("numpy.core", "numpy._core"):
    _READERS[f"{_core}.multiarray", "_reconstruct"] = _Array
    _READERS[f"{_core}.multiarray", "scalar"] = lambda kind, data: kind.read(data)[0]
    _READERS[f"{_core}.numeric", "_frombuffer"] = _shaped


# The unpickler in Python keeps its memo in a dictionary; the one in C reserves memory for an index that a file states.
class _Unpickler(pickle._Unpickler):
    dispatch = dict(pickle._Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        return _READERS.get((module, name), _Record)

    def load_bytearray8(self) -> None:
        # The one of Python reserves the bytes that the file states.
        file: Any = self
        (length,) = struct.unpack("<Q", file.read(8))
        file.append(bytearray(file.read(min(length, _MOST_STATISTICS))))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8  # type: ignore[assignment]


def _check_file(path: str | os.PathLike[str], most: int | None = None) -> None:
    """Refuses pipes, devices and, with `most`, larger files."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{os.fspath(path)}: it is not a regular file; give a file")
    if most is not None and os.path.getsize(path) > most:
        raise ValueError(f"{os.fspath(path)}: it has more than {most} bytes, and statistics have fewer; give another file")


def _values(statistic: Any) -> np.ndarray:
    """The values of an array or a number."""
    value = getattr(statistic, "value", statistic)
    if not isinstance(value, np.ndarray | np.generic | int | float):
        raise TypeError(f"{type(value).__name__} instead of an array")
    return np.array(value, np.float64)


class SB3Normalizer:
    """Normalises observations with the statistics that `VecNormalize` of Stable-Baselines3 saved.

    Args:
        stats_path: The file that `VecNormalize.save` wrote.
        clip_obs: The largest normalised value.
        epsilon: Added to the variance.

    Raises:
        ValueError: If the file has no such statistics.
    """

    def __init__(self, stats_path: str | os.PathLike[str], clip_obs: float = 10.0, epsilon: float = 1e-8) -> None:
        _check_file(stats_path, _MOST_STATISTICS)
        try:
            with open(stats_path, "rb") as file:
                statistics = _Unpickler(file).load().obs_rms
            self.mean, self.var = (_values(getattr(statistics, name)) for name in ("mean", "var"))
            if self.mean.size == 0 or self.mean.shape != self.var.shape:
                raise ValueError(f"a mean of shape {self.mean.shape} and a variance of shape {self.var.shape}")
        except OSError:
            raise
        # Damaged and hostile files raise anything.
        except Exception as error:
            raise ValueError(
                f"{stats_path}: it holds no statistics of VecNormalize ({error!s:.200}); save them with its save"
            ) from error
        self.clip_obs, self.epsilon = clip_obs, epsilon

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """The normalised observations."""
        return self.normalize(obs)

    def normalize(self, obs: np.ndarray) -> np.ndarray:
        """The normalised observations."""
        scaled = (np.asarray(obs) - self.mean) / np.sqrt(self.var + self.epsilon)
        normalised: np.ndarray = np.clip(scaled, -self.clip_obs, self.clip_obs)
        return normalised


class ExpertPolicy(BasePolicy):
    """Draws actions from the policy of SAC.

    Args:
        ckpt_path: The `.zip` file that `SAC.save` of Stable-Baselines3 wrote.
        vec_normalize_path: The file that `VecNormalize.save` wrote.
        noise_std: The standard deviation of the noise added to actions.
        seed: The seed of the actions and their noise.
        device: The device of torch.

    Raises:
        ValueError: If the file has no policy of SAC with linear layers.
    """

    type = "expert"

    def __init__(
        self,
        ckpt_path: str | os.PathLike[str],
        vec_normalize_path: str | os.PathLike[str],
        noise_std: float = 0.0,
        seed: int | None = None,
        device: str = "cpu",
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        import torch

        self.device, self.noise_std, self.rng = torch.device(device), noise_std, np.random.default_rng(seed)
        self.model = _policy(ckpt_path).to(self.device)
        self.normalizer = SB3Normalizer(vec_normalize_path)
        #: The seeds of torch are drawn from the policy's.
        self._generator = torch.Generator(self.device).manual_seed(int(self.rng.integers(2**62)))

    def get_action(self, info_dict: dict[str, Any], **kwargs: Any) -> np.ndarray:  # type: ignore[override]
        """The actions `(num_envs, A)` for infos whose `observation` is `(num_envs, D)` or `(num_envs, 1, D)`."""
        import torch

        if "observation" not in info_dict:
            raise KeyError("observation: the infos lack it; the policy acts on the observations of dm_control")
        observation = np.asarray(info_dict["observation"])
        observation = observation.reshape(-1, observation.shape[-1])
        with torch.no_grad():
            inputs = torch.as_tensor(self.normalizer(observation), dtype=torch.float32, device=self.device)
            mean, log_std = self.model(inputs).chunk(2, -1)
            noise = torch.randn(mean.shape, generator=self._generator, device=self.device)
            actions: np.ndarray = (mean + log_std.clamp(-20, 2).exp() * noise).tanh().cpu().numpy()
        if self.noise_std > 0:
            actions = actions + self.rng.normal(0, self.noise_std, actions.shape)
        clipped: np.ndarray = np.clip(actions, -1.0, 1.0).astype(np.float32)
        return clipped


def _policy(path: str | os.PathLike[str]) -> Any:
    """The network of a policy: observations `(B, D)` to means and logarithms of standard deviations `(B, 2 * A)`."""
    import torch
    from torch import nn

    _check_file(path)
    try:
        with zipfile.ZipFile(path) as archive, archive.open("policy.pth") as file:
            stored = archive.getinfo("policy.pth").file_size
            if archive.getinfo("data").file_size > _MOST_SETTINGS:
                raise ValueError(f"its settings have more than {_MOST_SETTINGS} bytes")
            if stored > max(8 * os.path.getsize(path), _MOST_SETTINGS):
                raise ValueError("its weights are more than 8 times larger than the file")
            # At its end, the checksum is compared.
            while file.read(1 << 20):
                pass
            file.seek(0)
            weights = torch.load(file, map_location="cpu", weights_only=True)
            settings = json.loads(archive.read("data"))
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: it is no model of Stable-Baselines3 ({error!s:.200}); save one with SAC.save") from error
    kwargs = (settings.get("policy_kwargs") or {}) if isinstance(settings, dict) else None
    if not isinstance(weights, dict) or not isinstance(kwargs, dict):
        raise ValueError(f"{path}: it is no model of Stable-Baselines3; save one with SAC.save")
    found = {name.removeprefix("actor."): value for name, value in weights.items() if name.startswith("actor.")}
    if not all(isinstance(value, torch.Tensor) for value in found.values()):
        raise ValueError(f"{path}: its weights are no tensors; save a model with SAC.save")
    # A tensor may repeat an element of the file any number of times.
    if sum(value.numel() * value.element_size() for value in found.values()) > stored:
        raise ValueError(f"{path}: its weights are larger than the file; save a model with SAC.save")
    hidden = sorted(
        {int(name.split(".")[1]) for name in found if name.startswith("latent_pi.") and name.endswith(".weight")},
    )
    if not hidden or "mu.weight" not in found or "log_std.weight" not in found:
        raise ValueError(f"{path}: it holds no policy of SAC with linear layers; train one with SAC('MlpPolicy', …)")
    activation = str(kwargs.get("activation_fn", "ReLU")).rpartition(".")[2].rstrip("'>")
    if activation not in _ACTIVATIONS:
        raise ValueError(f"{path}: the activation {activation!r} is unknown; expected one of {', '.join(_ACTIVATIONS)}")
    layers: list[nn.Module] = []
    heads = {part: torch.cat([found[f"{head}.{part}"] for head in ("mu", "log_std")]) for part in ("weight", "bias")}
    for parts in (*({part: found[f"latent_pi.{i}.{part}"] for part in heads} for i in hidden), heads):
        layer = nn.Linear(*reversed(parts["weight"].shape))
        layer.load_state_dict(parts)
        layers += [layer, getattr(nn, activation)()]
    return nn.Sequential(*layers[:-1]).requires_grad_(False)
