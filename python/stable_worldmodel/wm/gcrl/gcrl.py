"""`GCRL`: goal-conditioned policies from offline data (GCBC, GCIVL, GCIQL, HILP) on the patches of an image encoder.

Shapes: B clips, T frames, P patches of a frame, D features of a patch, A the action dimension.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from ..patches import PatchEncoder

__all__ = ["GCRL"]


class GCRL(PatchEncoder):
    """A goal-conditioned policy with optional values.

    GCBC trains the policy on the actions of the data; GCIVL, GCIQL and HILP weigh them by the advantage of a value.

    Args:
        encoder: An image encoder.
        action_predictor: The policy; see `Predictor`.
        value_predictor: The value: a `Predictor`, or a `MetricValuePredictor` for HILP; in a `WithTarget` for training.
        critic_predictor: The value of actions; see `QPredictor`.
        extra_encoders: Encoders of other columns, by name.
        history_size: Frames that the policy gets.
        interpolate_pos_encoding: Whether the encoder takes images of another size than it was trained with.
        log_std_min, log_std_max: Bounds of the logarithm of the policy's standard deviation.
    """

    def __init__(
        self,
        encoder: nn.Module,
        action_predictor: Any,
        value_predictor: nn.Module | None = None,
        critic_predictor: nn.Module | None = None,
        extra_encoders: Any = None,
        history_size: int = 3,
        interpolate_pos_encoding: bool = True,
        log_std_min: float = -5.0,
        log_std_max: float = 2.0,
    ) -> None:
        super().__init__(extra_encoders, interpolate_pos_encoding)
        self.encoder, self.action_predictor = encoder, action_predictor
        self.value_predictor, self.critic_predictor = value_predictor, critic_predictor
        self.history_size = history_size
        self.log_std_min, self.log_std_max = log_std_min, log_std_max
        last: Any = action_predictor.out_proj
        last = last[-1] if isinstance(last, nn.Sequential) else last
        self.log_stds = nn.Parameter(torch.zeros(last.out_features))

    def _image_encoder(self) -> Any:
        return self.encoder

    def encode(
        self,
        info: dict[str, Any],
        pixels_key: str = "pixels",
        emb_keys: Iterable[str] | None = None,
        prefix: str | None = None,
        target: str = "embed",
        is_video: bool = False,
    ) -> dict[str, Any]:
        """Adds the embedding `target` `(B, T, P, D)`; see `PreJEPA.encode`. The encoder gets gradients."""
        return self._embedded(info, pixels_key, emb_keys or None, prefix, target, is_video)

    def predict_actions(self, embedding: Tensor, embedding_goal: Tensor, temperature: float = 1.0) -> tuple[Tensor, Tensor]:
        """The policy of each frame: means `(B, T, A)` and standard deviations `(A,)`, times `temperature`.

        Args:
            embedding: Observations `(B, T, P, D)`.
            embedding_goal: Goals `(B, 1, P, D)`.
            temperature: Scales the standard deviations.
        """
        means = self.action_predictor(embedding.flatten(1, 2), embedding_goal.flatten(1, 2))
        return means, temperature * self.log_stds.clamp(self.log_std_min, self.log_std_max).exp()

    def predict_values(self, embedding: Tensor, embedding_goal: Tensor) -> Any:
        """The values `(B, T, 1)` of observations `(B, T, P, D)` for goals `(B, 1, P, D)`."""
        if self.value_predictor is None:
            raise ValueError("predict_values: the model has no value_predictor; pass one to the constructor")
        return self.value_predictor(embedding.flatten(1, 2), embedding_goal.flatten(1, 2))

    def get_action(self, info: dict[str, Any], sample: bool = False, temperature: float = 1.0) -> Tensor:
        """The actions `(B, A)` for the last frames of infos with `pixels` and `goal`.

        Args:
            info: The infos.
            sample: Whether actions are drawn from the policy; otherwise they are its means.
            temperature: Scales the standard deviations.
        """
        given = {key: value for key, value in info.items() if not key.endswith("embed")}
        given = self.encode(given)
        given = self.encode(given, pixels_key="goal", prefix="goal_", target="goal_embed")
        means, spread = self.predict_actions(given["embed"], given["goal_embed"], temperature)
        action = means[:, -1]
        return action + spread * torch.randn_like(action) if sample else action
