"""`JEPA`: a world model in the latent space of an image encoder, which LeWM and PLDM share. They differ in their losses.

Shapes: B clips or environments, S candidates, T steps, D the latent dimension, A the dimension of a model step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from .._overrides import is_overridden
from ..planning.evaluator import ShootingCostEvaluator, default_goal_encode
from ..planning.objective import GoalMSE
from .frames import Frames
from .pretrained import Pretrained

__all__ = ["JEPA"]


class JEPA(Pretrained):
    """An image encoder and a predictor of the next latent.

    A `stable_worldmodel.protocols.Dynamics`, and with `get_cost` a cost of solvers: the squared distance of the last
    predicted latent from the goal's latent.

    Args:
        encoder: Frames `(N, 3, H, W)` to features `(N, F)`, or to an object whose `last_hidden_state` `(N, tokens, F)` has
            the features first, such as a vision transformer of `transformers`.
        predictor: Latents and encoded actions `(B, T, D)` to the next latents; its `num_frames` is the history it takes.
        action_encoder: Actions `(B, T, A)` to `(B, T, D)`.
        projector: Features `(N, F)` to latents `(N, D)`.
        pred_proj: The predictor's output `(N, D)` to latents `(N, D)`.
    """

    def __init__(
        self,
        encoder: nn.Module,
        predictor: nn.Module,
        action_encoder: nn.Module,
        projector: nn.Module | None = None,
        pred_proj: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.encoder, self.predictor, self.action_encoder = encoder, predictor, action_encoder
        self.projector = nn.Identity() if projector is None else projector
        self.pred_proj = nn.Identity() if pred_proj is None else pred_proj
        #: How frames of `uint8` become inputs of the encoder.
        self.frames = Frames()
        #: The compiled `roll`, after `compile`.
        self._roll: Any = None

    def encode(self, info: dict[str, Any]) -> dict[str, Any]:
        """Adds `emb` `(B, T, D)`, the latents of `pixels`, and `act_emb` `(B, T, D)` if there is an `action`.

        `pixels` are normalised frames `(B, T, 3, H, W)`, or frames of `uint8`, also with the channels last.
        """
        parameter = next(self.encoder.parameters(), None)
        pixels = self.frames(info["pixels"], torch.float32 if parameter is None else parameter.dtype)
        clips, steps = pixels.shape[:2]
        latents = self.projector(self._features(pixels.flatten(0, 1)))
        info["emb"] = latents.unflatten(0, (clips, steps))
        if "action" in info:
            info["act_emb"] = self.action_encoder(info["action"])
        return info

    def _features(self, frames: Tensor) -> Tensor:
        interpolates = not hasattr(self.encoder, "takes_frames")
        output = self.encoder(frames, interpolate_pos_encoding=True) if interpolates else self.encoder(frames)
        hidden = getattr(output, "last_hidden_state", None)
        return output if hidden is None else hidden[:, 0]  # type: ignore[no-any-return]

    def predict(self, emb: Tensor, act_emb: Tensor) -> Tensor:
        """The latents `(B, T, D)` after each of the latents `emb`, of which each depends on the latents before it."""
        predicted = self.predictor(emb, act_emb)
        return self.pred_proj(predicted.flatten(0, 1)).unflatten(0, predicted.shape[:2])  # type: ignore[no-any-return]

    def rollout(self, info: dict[str, Any], action_sequence: Tensor, history_size: int | None = None) -> dict[str, Any]:
        """Adds `predicted_emb` `(B, S, T + H, D)`: the latents of T observed frames, and the predictions for H steps.

        Args:
            info: `pixels` `(B, S, T, ..)`, equal for all candidates of an environment; with T above 1 also `action_history`
                `(B, S, T - 1, A)`, the actions between the frames. The latents of the frames are kept as `emb`.
            action_sequence: Candidates `(B, S, H, A)`. If there is no `action_history`, they begin with the T - 1 actions
                between the frames.
            history_size: The number of latents that the predictor gets; its `num_frames` for `None`.
        """
        history = int(getattr(self.predictor, "num_frames", 3)) if history_size is None else history_size
        envs, samples = action_sequence.shape[:2]
        if "emb" not in info:
            self._encode_start(info, samples)
        observed = info["emb"].flatten(0, 1)
        past, frames = info.get("action_history"), observed.shape[1]
        if frames > 1 and past is not None and past.shape[2]:
            past = past[:, :, -(frames - 1) :].to(action_sequence)
            action_sequence = torch.cat([past.expand(-1, samples, -1, -1), action_sequence], 2)
        latents = self._predicted(observed, self.action_encoder(action_sequence.flatten(0, 1)), history)
        info["predicted_emb"] = latents.unflatten(0, (envs, samples))
        return info

    def _encode_start(self, info: dict[str, Any], samples: int) -> None:
        """Adds `emb` `(B, S, T, D)`, the latents of the observed frames, which get no gradient from a plan."""
        first = {key: value[:, 0] for key, value in info.items() if torch.is_tensor(value) and key == "pixels"}
        info["emb"] = self.encode(first)["emb"].detach().unsqueeze(1).expand(-1, samples, -1, -1)

    def _predicted(self, observed: Tensor, actions: Tensor, history: int) -> Tensor:
        """The latents of the observed frames, then the predictions, for encoded actions `(N, T, D)`."""
        # The package `lewm` imports this module.
        from .lewm.rollout import roll, rolls

        predictor: Any = self.predictor
        if torch.compiler.is_compiling():
            # `torch.compile` cannot follow the whole check.
            is_own = type(self).predict is JEPA.predict
        else:
            is_own = not (is_overridden(self, "predict") or self.pred_proj.training)
        if is_own and history <= getattr(predictor, "num_frames", 0) and rolls(predictor):
            rolled: Tensor = (self._roll or roll)(predictor, observed, actions, self.pred_proj, history)
            return rolled
        latents = list(observed.unbind(1))
        for now in range(len(latents), actions.shape[1] + 1):
            begin = max(0, now - history)
            window = torch.stack(latents[begin:now], 1)
            latents.append(self.predict(window, actions[:, begin:now])[:, -1])
        return torch.stack(latents, 1)

    def prepare_plan(self, info: dict[str, Any], samples: int) -> None:
        """Adds to the infos of a plan what does not depend on the candidates: the latents of the frames and of the goal.

        On an NVIDIA GPU, solvers record `get_cost` for infos that have them as a CUDA graph, and replay it for every
        iteration. A class whose `get_cost` depends on anything but the infos' tensors, the candidates and the
        weights sets `prepare_plan = None`.
        """
        if "emb" not in info:
            self._encode_start(info, samples)
        if "goal_emb" not in info:
            default_goal_encode(self, info)

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compiles the encoder and the predictions of plans with `torch.compile`, which takes the arguments.

        Predictions of an overridden `predict` or of a changed predictor are not compiled. Training compiles on its own
        (`compile=true` of `stable_worldmodel.train`).
        """
        from .lewm.rollout import roll

        self.encoder.compile(*args, **kwargs)
        self._roll = torch.compile(roll, *args, **kwargs)

    def criterion(self, info_dict: dict[str, Any], action_candidates: Tensor | None = None) -> Tensor:
        """The costs `(B, S)` of infos that hold a rollout and the goal's latents `goal_emb`. Override it for another cost."""
        return GoalMSE()(info_dict)  # type: ignore[no-any-return]

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Tensor) -> Tensor:
        """The costs `(B, S)` of candidates `(B, S, H, A)`, for infos `(B, S, T, ..)` with `pixels` and `goal`."""
        evaluator = ShootingCostEvaluator(self, lambda info: self.criterion(info, action_candidates))
        return evaluator.get_cost(info_dict, action_candidates)
