"""Libraries of optional extras that stand in the place of T6-GPS."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec

from t6gps.service.studies.declared import BY_HAND, Baseline, Rival
from t6gps.storage.errors import ConfigError

GYMNASIUM, PPO, OFF_POLICY, CMA_ES = "gymnasium", "stable_baselines3", "sb3_contrib", "cmaes"


def needed(baseline: Baseline | Rival | None) -> tuple[str, ...]:
    """Modules that something in the place of T6-GPS imports."""
    if baseline is None or baseline is Baseline.PERIODIC or baseline in BY_HAND:
        return ()
    if baseline in (Rival.CPG, Rival.CMA_ES):
        return (CMA_ES,)
    on_policy = baseline in (Baseline.PPO, Rival.PPO_ABSOLUTE, Rival.PPO_RATES)
    return (GYMNASIUM, PPO) if on_policy else (GYMNASIUM, PPO, OFF_POLICY)


def check_installed(arms: Mapping[str, Baseline | Rival | None]) -> None:
    """ConfigError if an arm needs a library that is not installed, before anything is sampled."""
    for arm, baseline in arms.items():
        for module in needed(baseline):
            if find_spec(module) is None:
                extra = "baselines" if isinstance(baseline, Baseline) else "rivals"
                raise ConfigError(
                    f"arm {arm} needs {module.replace('_', '-')}, which is not installed; run: "
                    f"pip install 't6gps[{extra}]', or choose other arms with --arms"
                )
