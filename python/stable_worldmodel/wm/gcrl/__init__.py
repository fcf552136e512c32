"""Goal-conditioned learning from offline data."""

from .gcrl import GCRL
from .module import (
    DoublePredictorWrapper,
    Embedder,
    ExpectileLoss,
    MetricValuePredictor,
    Predictor,
    QPredictor,
)

__all__ = [
    "GCRL",
    "DoublePredictorWrapper",
    "Embedder",
    "ExpectileLoss",
    "MetricValuePredictor",
    "Predictor",
    "QPredictor",
]
