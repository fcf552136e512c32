"""`PreJEPA`: a world model on the patches of a pretrained, frozen image encoder (DINO-WM, Zhou et al., 2025).

Shapes: B clips or environments, S candidates, T frames, P patches, D features of a patch, A the dimension of a model step.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ...planning.evaluator import ShootingCostEvaluator, split_goal_encode
from ...planning.objective import GoalMSE, WeightedSum
from ..patches import PatchEncoder

__all__ = ["PreJEPA"]


class PreJEPA(PatchEncoder):
    """DINO-WM. The loss is the squared error of the next frame's patches, `predict(emb)` against `emb` one step later.

    Args:
        encoder: A pretrained encoder, which gets no gradient: see `create_backbone`.
        predictor: Patches `(B, T * P, D)` to those of the next frames: see `CausalPredictor`.
        extra_encoders: Encoders of other columns, by name; `action` is the encoder of the actions.
        decoder: Patches `(B, T, P, ..)` to images and a loss, for `decode`.
        history_size: Frames that the predictor gets.
        num_pred: Frames that a training step predicts.
        interpolate_pos_encoding: Whether the encoder takes images of another size than it was trained with.
    """

    def __init__(
        self,
        encoder: nn.Module,
        predictor: nn.Module,
        extra_encoders: Any = None,
        decoder: nn.Module | None = None,
        history_size: int = 3,
        num_pred: int = 1,
        interpolate_pos_encoding: bool = True,
    ) -> None:
        super().__init__(extra_encoders, interpolate_pos_encoding)
        self.backbone, self.predictor, self.decoder = encoder, predictor, decoder
        self.history_size, self.num_pred = history_size, num_pred

    def _image_encoder(self) -> Any:
        return self.backbone

    def encode(
        self,
        info: dict[str, Any],
        pixels_key: str = "pixels",
        emb_keys: Iterable[str] | None = None,
        prefix: str | None = None,
        target: str = "emb",
        is_video: bool = False,
    ) -> dict[str, Any]:
        """Adds the embedding `target` `(B, T, P, D)`, and its parts `pixels_TARGET` and `COLUMN_TARGET`.

        Args:
            info: Frames `(B, T, 3, H, W)` and columns `(B, T, ..)`.
            pixels_key: The key of the frames.
            emb_keys: The columns to append; those of `extra_encoders` for `None`.
            prefix: The prefix of the columns' keys.
            target: The key of the embedding.
            is_video: Whether the encoder takes videos.
        """
        return self._embedded(info, pixels_key, emb_keys, prefix, target, is_video)

    def _image_patches(self, frames: Tensor) -> Tensor:
        return super()._image_patches(frames).detach()

    def predict(self, embedding: Tensor) -> Tensor:
        """The embeddings `(B, T, P, D)` of the frames after each of the frames `embedding`."""
        return self.predictor(embedding.flatten(1, 2)).unflatten(1, embedding.shape[1:3])  # type: ignore[no-any-return]

    def decode(self, info: dict[str, Any]) -> dict[str, Any]:
        """Adds `reconstructed_pixels` `(B, T, 3, H, W)`, and the decoder's loss `reconstruction_diff`."""
        if self.decoder is None:
            raise ValueError("decode: the model has no decoder; pass one to the constructor")
        images, loss = self.decoder(info["pixels_emb"])
        info["reconstructed_pixels"] = images.unflatten(0, (-1, info["pixels_emb"].shape[1]))
        info["reconstruction_diff"] = loss
        return info

    def split_embedding(self, embedding: Tensor, extra_dims: Sequence[int]) -> dict[str, Tensor]:
        """The parts of an embedding `(B, S, T, P, D)`: `pixels_emb`, and `COLUMN_emb` `(B, S, T, ..)` of these sizes."""
        sizes = [embedding.shape[-1] - sum(extra_dims), *extra_dims]
        pixels, *columns = embedding.split(sizes, -1)
        # All patches of a frame have the same columns.
        named = zip(self.extra_encoders, columns, strict=True)
        return {"pixels_emb": pixels, **{f"{name}_emb": column[:, :, :, 0] for name, column in named}}

    def replace_action_in_embedding(self, embedding: Tensor, act: Tensor) -> Tensor:
        """The embedding `(B, S, T, P, D)` with the encoded actions `act` `(B, S, T, A)` in place of its own."""
        if "action" not in self.extra_encoders:
            raise ValueError("replace_action_in_embedding: the model has no encoder of actions among its extra_encoders")
        encoded = self.extra_encoders["action"](act.flatten(0, 1)).unflatten(0, act.shape[:2])
        names = list(self.extra_encoders)
        sizes = [self.extra_encoders[name].emb_dim for name in names]
        parts = list(embedding.split([embedding.shape[-1] - sum(sizes), *sizes], -1))
        parts[1 + names.index("action")] = encoded.unsqueeze(3).expand(-1, -1, -1, embedding.shape[3], -1)
        return torch.cat(parts, -1)

    def rollout(self, info: dict[str, Any], action_sequence: Tensor) -> dict[str, Any]:
        """Adds the embeddings of T observed frames and of the H frames after them, for each candidate.

        Args:
            info: `pixels` `(B, S, T, ..)` and the other columns, equal for all candidates of an environment; with T above 1
                also `action_history` `(B, S, T - 1, A)`, the actions between the frames.
            action_sequence: Candidates `(B, S, H, A)`. If there is no `action_history`, they begin with the T - 1 actions
                between the frames.

        Returns:
            The infos with `predicted_emb` `(B, S, T + H, P, D)` (also as `predicted_embedding`) and its parts
            `predicted_pixels_emb` and `predicted_COLUMN_emb`.
        """
        samples = action_sequence.shape[1]
        if "emb" not in info:
            info["emb"] = self._observed(info, action_sequence).unsqueeze(1).expand(-1, samples, -1, -1, -1)
        seen = info["emb"].shape[2]
        past = info.get("action_history")
        if seen > 1 and past is not None and past.shape[2]:
            past = past[:, :, -(seen - 1) :].to(action_sequence)
            action_sequence = torch.cat([past.expand(-1, samples, -1, -1), action_sequence], 2)
        frames = self.replace_action_in_embedding(info["emb"], action_sequence[:, :, :seen])
        for step in range(seen, action_sequence.shape[2]):
            predicted = self._next(frames)
            action = action_sequence[:, :, step : step + 1]
            frames = torch.cat([frames, self.replace_action_in_embedding(predicted, action)], 2)
        frames = torch.cat([frames, self._next(frames)], 2)
        info["predicted_emb"] = info["predicted_embedding"] = frames
        sizes = [self.extra_encoders[name].emb_dim for name in self.extra_encoders]
        parts = self.split_embedding(frames, sizes)
        info.update((f"predicted_{name}", part) for name, part in parts.items())
        return info

    def _observed(self, info: dict[str, Any], actions: Tensor) -> Tensor:
        """The embedding `(B, T, P, D)` of the observed frames, with any actions, which a rollout replaces."""
        first = {key: value[:, 0] for key, value in info.items() if torch.is_tensor(value) and value.ndim > 1}
        steps = first["pixels"].shape[1]
        first["action"] = actions.new_zeros(len(actions), steps, actions.shape[-1])
        for target in [key for key in first if key == "emb" or key.endswith("_emb")]:
            del first[target]
        embedding: Tensor = self.encode(first)["emb"]
        return embedding.detach()

    def _next(self, frames: Tensor) -> Tensor:
        """The embedding `(B, S, 1, P, D)` of the frame after the frames `(B, S, T, P, D)`."""
        latest = frames[:, :, -self.history_size :].flatten(0, 1)
        following: Tensor = self.predict(latest)[:, -1:].unflatten(0, frames.shape[:2])
        return following

    def criterion(self, info_dict: dict[str, Any], action_candidates: Tensor | None = None) -> Tensor:
        """The costs `(B, S)` of infos that hold a rollout and the goal: the mean squared error of each part, added up."""
        names = ["pixels", *(name for name in self.extra_encoders if name != "action")]
        terms = [(1.0, GoalMSE(f"predicted_{name}_emb", f"{name}_goal_emb", "mean")) for name in names]
        return WeightedSum(terms)(info_dict)  # type: ignore[no-any-return]

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Tensor) -> Tensor:
        """The costs `(B, S)` of candidates `(B, S, H, A)`, for infos `(B, S, T, ..)` with `pixels` and `goal`."""
        objective = lambda info: self.criterion(info, action_candidates)  # noqa: E731
        evaluator = ShootingCostEvaluator(self, objective, encode_goal=split_goal_encode)
        return evaluator.get_cost(info_dict, action_candidates)
