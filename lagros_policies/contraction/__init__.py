"""Contraction metrics (CV-STEM), the robust control u* and the tubes that follow from them."""

from lagros_envs.aliases import moved_names
from lagros_policies.contraction.basis import Basis, cosines, harmonics, powers, products
from lagros_policies.contraction.condition import (
    contraction_residual,
    search_violation,
    verify_metric,
)
from lagros_policies.contraction.control import HeldControl, robust_control
from lagros_policies.contraction.cvstem import (
    CvStemSettings,
    InfeasibleError,
    design_metric,
    design_on_pool,
    design_on_region,
    search_rate,
)
from lagros_policies.contraction.metric import (
    ContractionMetric,
    Metric,
    Verification,
    extreme_eigenvalues,
)
from lagros_policies.contraction.metric_files import load_metric, save_metric
from lagros_policies.contraction.regions import (
    BoxRegion,
    MetricRegion,
    PlanRegion,
    Samples,
)
from lagros_policies.contraction.tube import Tube, certified_tube, diverging_bound, tighten

__all__ = [
    "Basis",
    "BoxRegion",
    "ContractionMetric",
    "CvStemSettings",
    "HeldControl",
    "InfeasibleError",
    "Metric",
    "MetricRegion",
    "PlanRegion",
    "Samples",
    "Tube",
    "Verification",
    "certified_tube",
    "contraction_residual",
    "cosines",
    "design_metric",
    "design_on_pool",
    "design_on_region",
    "diverging_bound",
    "extreme_eigenvalues",
    "harmonics",
    "load_metric",
    "powers",
    "products",
    "robust_control",
    "save_metric",
    "search_rate",
    "search_violation",
    "tighten",
    "verify_metric",
]

moved_names(__name__)
