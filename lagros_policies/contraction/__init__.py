"""Contraction metrics (CV-STEM), the robust control u* and the tubes that follow from them."""

from lagros_policies.contraction.condition import Samples, contraction_residual, verify_metric
from lagros_policies.contraction.control import HeldControl, robust_control
from lagros_policies.contraction.cvstem import (
    CvStemSettings,
    InfeasibleError,
    design_metric,
    design_on_pool,
    search_rate,
)
from lagros_policies.contraction.metric import (
    ContractionMetric,
    Metric,
    Region,
    Verification,
    extreme_eigenvalues,
)
from lagros_policies.contraction.metric_files import load_metric, save_metric
from lagros_policies.contraction.tube import Tube, certified_tube, diverging_bound, tighten

__all__ = [
    "ContractionMetric",
    "CvStemSettings",
    "HeldControl",
    "InfeasibleError",
    "Metric",
    "Region",
    "Samples",
    "Tube",
    "Verification",
    "certified_tube",
    "contraction_residual",
    "design_metric",
    "design_on_pool",
    "diverging_bound",
    "extreme_eigenvalues",
    "load_metric",
    "robust_control",
    "save_metric",
    "search_rate",
    "tighten",
    "verify_metric",
]
