"""`PatchEncoder`: the patches of frames and other columns as one embedding, which `PreJEPA` and `GCRL` share.

Shapes: B clips, T frames, P patches of a frame, D features of a patch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from .frames import Frames
from .pretrained import Pretrained

__all__ = ["PatchEncoder"]


class PatchEncoder(Pretrained):
    """Base class of models on the patches of an image encoder.

    The embedding of a frame is the features of its patches; the encoded columns of the step are appended to every patch.
    """

    def __init__(self, extra_encoders: Any, interpolate_pos_encoding: bool) -> None:
        super().__init__()
        self.extra_encoders: Any = extra_encoders if extra_encoders is not None else nn.ModuleDict()
        self.interpolate_pos_encoding = interpolate_pos_encoding
        #: How frames of `uint8` become inputs of the encoder.
        self.frames = Frames()
        #: The mean and the standard deviation by which columns are scaled before they are encoded.
        self.scales: dict[str, tuple[Tensor, Tensor]] = {}

    def _image_encoder(self) -> Any:
        raise NotImplementedError

    def _embedded(
        self,
        info: dict[str, Any],
        pixels_key: str,
        emb_keys: Iterable[str] | None,
        prefix: str | None,
        target: str,
        is_video: bool,
    ) -> dict[str, Any]:
        """Adds `target` `(B, T, P, D)`, and its parts `pixels_TARGET` `(B, T, P, ..)` and `COLUMN_TARGET` `(B, T, ..)`."""
        if target in info:
            raise ValueError(f"encode: the infos have {target!r} already; give another target, or remove it")
        frames = self.frames(info[pixels_key])
        patches = self._video_patches(frames) if is_video else self._image_patches(frames)
        info[f"pixels_{target}"] = patches
        parts = [patches]
        for column in self.extra_encoders if emb_keys is None else emb_keys:
            encoded = self.extra_encoders[column](self._scaled(column, info[f"{prefix or ''}{column}"]))
            info[f"{column}_{target}"] = encoded
            parts.append(encoded.unsqueeze(2).expand(-1, -1, patches.shape[2], -1))
        info[target] = torch.cat(parts, -1)
        return info

    def _scaled(self, column: str, values: Tensor) -> Tensor:
        """The values of a column in the units of its encoder; missing ones (NaN) are the mean."""
        if column not in self.scales:
            return values.float()
        mean, std = (part.to(values.device) for part in self.scales[column])
        return ((values.float().double() - mean) / std).nan_to_num().float()

    def _encoded(self, images: Tensor) -> Any:
        interpolation = {"interpolate_pos_encoding": True} if self.interpolate_pos_encoding else {}
        return self._image_encoder()(images, **interpolation)

    def _image_patches(self, frames: Tensor) -> Tensor:
        """The patches of each frame on its own, `(B, T, P, ..)`; an encoder without patches gives one."""
        encoder = self._image_encoder()
        if hasattr(encoder, "patches"):
            return encoder.patches(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])  # type: ignore[no-any-return]
        output = self._encoded(frames.flatten(0, 1))
        hidden = getattr(output, "last_hidden_state", None)
        if hidden is None:
            patches = output.logits.unsqueeze(1)
        else:
            patches = hidden[:, _other_tokens(encoder, frames.shape[-2:], hidden.shape[1]) :]
        return patches.unflatten(0, frames.shape[:2])  # type: ignore[no-any-return]

    def _video_patches(self, frames: Tensor) -> Tensor:
        """The patches of each frame in the video up to it, whose last frame is repeated, `(B, T, P, ..)`."""
        steps = frames.shape[1]
        videos = [
            torch.cat([frames[:, : t + 1], frames[:, t : t + 1].expand(-1, steps - t - 1, -1, -1, -1)], 1) for t in range(steps)
        ]
        return torch.stack([self._encoded(video).last_hidden_state for video in videos], 1)


def _other_tokens(encoder: Any, size: Sequence[int], tokens: int) -> int:
    """The number of tokens before those of the patches: of the whole image and registers, or none.

    Args:
        encoder: The encoder; one whose `config` has no `patch_size` has one such token.
        size: Height and width of the frames.
        tokens: All tokens of a frame.
    """
    patch = getattr(getattr(encoder, "config", None), "patch_size", None)
    if patch is None:
        return 1
    height, width = (patch, patch) if isinstance(patch, int) else patch
    others = tokens - (size[0] // height) * (size[1] // width)
    return others if 0 <= others < tokens else 1
