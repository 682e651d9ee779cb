"""The evaluation of a fitted model on a dataset's test part: numbers, figures and a page."""

from tapetum.report.binned import Binned, binned_errors
from tapetum.report.evaluation.classes import (
    Reliability,
    brier_score,
    confusion,
    novelty_auroc,
    reliability,
    top_1,
)
from tapetum.report.evaluation.outcome import Outcome, gather, gather_parts
from tapetum.report.evaluation.scores import (
    ClassScores,
    ErrorMap,
    Group,
    by_device,
    by_recording,
    by_snr,
    error_map,
    score,
    score_classes,
)
from tapetum.report.evaluation.summary import describe, evaluate_model
from tapetum.report.evaluation.write import Subject, write_evaluation

__all__ = [
    "Binned",
    "ClassScores",
    "ErrorMap",
    "Group",
    "Outcome",
    "Reliability",
    "Subject",
    "binned_errors",
    "brier_score",
    "by_device",
    "by_recording",
    "by_snr",
    "confusion",
    "describe",
    "error_map",
    "evaluate_model",
    "gather",
    "gather_parts",
    "novelty_auroc",
    "reliability",
    "score",
    "score_classes",
    "top_1",
    "write_evaluation",
]
