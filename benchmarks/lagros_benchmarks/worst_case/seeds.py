"""Which seeds belong to searched worst cases, to the calibration and to its check.

Namespaces of `lagros_envs.seeding.episode_seeds`, words in ASCII: no figure here comes from an
episode on which policies are judged or trained.
"""

from __future__ import annotations

ATTACK = 0x61747461  # "atta"
CALIBRATION = 0x63616C69  # "cali"
VERIFICATION = 0x76657269  # "veri"
