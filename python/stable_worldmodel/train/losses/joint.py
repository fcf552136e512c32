"""The losses of LeWM and PLDM, whose encoder and predictor are trained together.

Shapes: B clips of a batch on all ranks, T steps, D the latent dimension, A the dimension of a model step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from ..._overrides import is_overridden
from ...wm.jepa import JEPA
from ...wm.loss import PLDMLoss, SIGReg, TemporalStraighteningLoss
from ...wm.pretrained import Pretrained
from ..ranks import Ranks
from .base import Losses, windows

__all__ = ["Joint", "LeWMLosses", "PLDMLosses"]


class Joint(Losses):
    """Base class of LeWM and PLDM: the squared error of predicted latents and a regulariser of all latents.

    Every rank encodes its slice. The features of all ranks are gathered, because normalisations and regularisers depend on
    the whole batch. Methods `encode` and `predict` of a class of the user are called as they are.
    """

    whole_batch = True
    model: JEPA

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        if getattr(self.model, "decoder", None) is not None:
            raise ValueError("model.decoder: it has no loss in torch; train this configuration with swm train")
        model = self.model
        self._features = compiled(model._features)
        #: The user's methods; `None` where the class has those of this package, whose parts are called one by one.
        self._encode = compiled(model.encode) if is_overridden(model, "encode") else None
        self._predict = compiled(model.predict) if is_overridden(model, "predict") else None
        self._predictor = model.predictor if self._predict else compiled(model.predictor)

    @classmethod
    def check_kind(cls, kind: type[Pretrained] | None, ranks: Ranks) -> None:
        super().check_kind(kind, ranks)
        if ranks.size > 1 and kind is not None and issubclass(kind, JEPA) and is_overridden(kind, "encode"):
            raise TypeError(
                f"{kind.__name__}.encode: {ranks.size} processes encode slices of a batch and would not call it, because they "
                "normalise the features of the whole batch; train in one process, or change the networks instead"
            )

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        model, pixels = self.model, batch["pixels"]
        count, steps, device = len(pixels), pixels.shape[1], pixels.device
        actions = self.ranks.gather(self.actions(batch) if count else None, sizes, device, differentiable=False)
        z, encoded = self._latents(batch, actions, sizes)
        history = self._history(steps)
        past = windows(z, history, 0)
        with self.precision():
            taken = model.action_encoder(windows(actions, history, 0)) if encoded is None else windows(encoded, history, 0)
            if self._predict is not None:
                predicted = self._predict(past, taken)
            else:
                predicted = self._predictor(past, taken)
                predicted = model.pred_proj(predicted.flatten(0, 1)).unflatten(0, (-1, history))
        z = z.float()
        prediction = (predicted.float() - windows(z, history, 1)).square().mean()
        regulariser, terms = self.regularise(z, actions)
        return {"loss": prediction + regulariser, "prediction": prediction, **terms}

    def _latents(self, batch: Mapping[str, Tensor], actions: Tensor, sizes: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """The latents `(B, T, D)` of all ranks' frames, and the encoded actions if the user's `encode` has made them."""
        model, pixels = self.model, batch["pixels"]
        count, steps = len(pixels), pixels.shape[1]
        with self.precision():
            if self._encode is not None:
                info = self._encode({"pixels": pixels, "action": actions})
                return info["emb"], info.get("act_emb")
            features = self._features(model.frames(pixels).flatten(0, 1)) if count else None
        gathered = self.ranks.gather(features, [size * steps for size in sizes], pixels.device)
        with self.precision():
            return model.projector(gathered).unflatten(0, (-1, steps)), None

    def _history(self, steps: int) -> int:
        return min(int(self.model.predictor.num_frames), steps - 1)  # type: ignore[arg-type]

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The regulariser of the latents `(B, T, D)`, and its terms."""
        raise NotImplementedError


class LeWMLosses(Joint):
    """LeWM: SIGReg (Maes et al., 2026), and optionally straight paths of latents."""

    names: tuple[str, ...] = ("loss", "prediction", "sigreg")

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        super().compile(compiled)
        #: The weight of straight paths.
        self.straight = float(self.settings.get("temp_straight", 0.0))
        if self.straight:
            self.names = (*self.names, "temp_straight")
        self.sigreg = SIGReg(self.settings["knots"], self.settings["directions"])

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        sigreg = self.sigreg.to(z.device)(z.transpose(0, 1))
        total, terms = self.settings["weight"] * sigreg, {"sigreg": sigreg}
        if self.straight:
            terms["temp_straight"] = TemporalStraighteningLoss()(z)
            total = total + self.straight * terms["temp_straight"]
        return total, terms


class PLDMLosses(Joint):
    """PLDM: variance, covariance, temporal alignment, and inverse dynamics (Sobal et al., 2025)."""

    names = ("loss", "prediction", "std", "std_t", "cov", "cov_t", "temp_align", "idm", "temp_straight")

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        idm: Any = self.model.idm
        found = PLDMLoss()(z, idm(z), actions[:, :-1])
        terms = {name.removesuffix("_loss"): term for name, term in found.items()}
        terms["temp_straight"] = TemporalStraighteningLoss()(z) if z.shape[1] > 2 else z.new_zeros(())
        total: Any = sum(self.settings[name] * term for name, term in terms.items() if self.settings[name])
        return total, terms
