"""Which accelerations keep an agent clear of what it senses, and the nearest of them."""

from lagros_envs.aliases import moved_names
from lagros_policies.safety.barrier import BarrierSettings, BrakingBarrier, HalfPlanes
from lagros_policies.safety.half_planes import nearest

__all__ = ["BarrierSettings", "BrakingBarrier", "HalfPlanes", "nearest"]
moved_names(__name__)
