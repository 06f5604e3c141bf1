"""Each sentence of the diagnosis appears for the tables that call for it, and for no others."""

from __future__ import annotations

from typing import Any

import pytest

from t6gps.service.config import parse
from t6gps.service.views.diagnosis import diagnose

HEALTHY = {
    "cost_standard_error": 0.01, "forward_speed_m_per_s": 0.45, "stuck_share_by_distance": 0.01, "modes": 1.2,
    "predicted_cost_change": -0.2, "supervised_loss_before": 0.2, "supervised_loss": 0.15, "policy_kl": 0.8,
    "saturated_share": 0.02,
}  # fmt: skip
COSTS = (1.0, 0.43, 0.42, 0.36)


def iterations(costs: tuple[float, ...] = COSTS, **newest: Any) -> list[dict[str, Any]]:
    rows = [
        HEALTHY | {"iteration": number, "policy_version": number, "cost": cost} for number, cost in enumerate(costs)
    ]
    rows[-1].update(newest)
    return rows


def classes(pooled_rows: int = 150, time_steps: int = 8) -> list[dict[str, Any]]:
    """Two classes of the newest iteration, and one of an earlier one that must not count."""
    frequent = {"iteration": 3, "rows": 850, "time_steps": time_steps, "pooled": False}
    return [
        frequent,
        frequent | {"rows": pooled_rows, "pooled": True},
        frequent | {"iteration": 2, "rows": 10**6, "pooled": True},
    ]


def test_a_healthy_run_is_well() -> None:
    (sentence,) = diagnose(iterations(), classes())
    assert sentence.startswith("All well: the cost fell from 1.000 to 0.360")


def test_one_iteration_is_not_judged() -> None:
    (sentence,) = diagnose(iterations((1.0,), forward_speed_m_per_s=0.0), classes())
    assert "untrained policy" in sentence


PLANTED = {
    "step was too large": (iterations((1.0, 0.43, 0.5, 0.36)), classes(), "from 0.430 to 0.500"),
    "Learning has stopped": (iterations((1.0, 0.43, 0.42, 0.435)), classes(), "-0.400"),
    "goes nowhere": (iterations(forward_speed_m_per_s=0.02), classes(), "0.020 m/s"),
    "stands still": (iterations(stuck_share_by_distance=0.4), classes(), "40%"),
    "policy is saturated": (iterations(saturated_share=0.31), classes(), "31%"),
    "does not take up": (iterations(supervised_loss=0.196), classes(), "from 0.200 to 0.196"),
    "Classes are starved": (iterations(), classes(pooled_rows=850), "50%"),
    "too little data for several modes": (iterations(modes=1.0), classes(), "106 samples"),
}


@pytest.mark.parametrize("finding", PLANTED)
def test_each_planted_trouble_is_named_alone_with_its_figure_and_a_setting_to_try(finding: str) -> None:
    rows, class_rows, figure = PLANTED[finding]
    (sentence,) = diagnose(rows[::-1], class_rows)
    assert finding in sentence and figure in sentence
    assert "try " in sentence and sentence.endswith(".")


def test_the_settings_to_try_exist() -> None:
    known = parse("{}").model_dump()
    for rows, class_rows, _ in PLANTED.values():
        words = " ".join(diagnose(rows, class_rows)).replace(",", " ").replace(";", " ").replace("(", " ").split()
        named = [word.strip(").") for word in words if word.split(".")[0] in known and "." in word.strip(").")]
        assert named
        for name in named:
            section, _, key = name.partition(".")
            assert key in known[section], name


def test_a_pipelined_run_is_judged_by_what_each_policy_was_learned_from() -> None:
    def pipelined(*costs: float) -> list[dict[str, Any]]:
        return [row | {"policy_version": max(row["iteration"] - 1, 0)} for row in iterations(costs)]

    assert diagnose(pipelined(1.0, 0.95, 0.4, 0.45), classes())[0].startswith("All well")  # two lines of descent
    (sentence,) = diagnose(pipelined(1.0, 0.95, 0.4, 0.6, 0.5), classes())
    assert "too large: after iteration 2 the cost rose from 0.400 to 0.500" in sentence
    (sentence,) = diagnose(pipelined(0.5, 0.5, 0.49, 0.5, 0.505), classes())
    assert "went from 0.500 to 0.505" in sentence and "-0.400" in sentence


def test_one_mode_in_large_bins_is_no_lack_of_data() -> None:
    assert diagnose(iterations(modes=1.0), classes(time_steps=2))[0].startswith("All well")


def test_a_rise_within_two_standard_errors_is_chance() -> None:
    assert diagnose(iterations((1.0, 0.43, 0.455, 0.36)), classes())[0].startswith("All well")


def test_columns_that_older_runs_lack_say_nothing() -> None:
    missing = dict.fromkeys(("supervised_loss_before", "policy_kl", "saturated_share", "stuck_share_by_distance"))
    rows = [row | missing for row in iterations()]
    assert diagnose(rows, classes())[0].startswith("All well")
    rising = [row | missing for row in iterations((1.0, 0.43, 0.5, 0.36))]
    assert "nat" not in diagnose(rising, classes())[0]


def test_several_troubles_are_all_named() -> None:
    assert len(diagnose(iterations(saturated_share=0.5, stuck_share_by_distance=0.5), classes(pooled_rows=900))) == 3
