"""A small run of study_ins_alignment writes its page and plots, and its figures obey what is known of them."""

import math
import re

import numpy as np
import pytest

from studies import ins_alignment as study
from studies import standing_runs as runs
from studies.standing_runs import DEG, GRADES

DURATION = 40.0  # s, just beyond a coarse alignment
BOUND_DURATION = 72.0  # s, in which the noisiest velocity tells the heading
STILL = 20.0  # s
NOISE_PART = 0.03  # of a standard deviation, from 6000 draws: 3 sigma
SAME = 0.02  # part by which IPEKF and EKF5 may differ at the default weights
BOUND_PART = 0.2  # of the time that the closed form of a bound leaves out: heading and tilt are known a little
SECTIONS = ("Asked and got", "Table 2 side by side", "Figures 3 to 9", "The paper's claims",
            "The predictive algorithm", "Large heading errors", "Any initial heading", "The default chain", "ALIGNED",
            "Disturbances", "Table 3: load")
FIGURES = ("figure_3", "figures_4_5", "figure_6", "figures_7_9", "ipa", "chain")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as short:
        for name, value in {"DURATION": DURATION, "SHORT": DURATION, "MOTIONS": 1, "MORE_SEEDS": 1, "HORIZONS": (2, 10),
                            "LARGE_ERRORS_DEG": (30,), "STRENGTHS": (1.0,), "RATIOS": (1e-4, 1e-2),
                            "RUNS_A_SEED": 1, "STEP_ROUNDS": 2, "CHAIN_GRADES": ("navigation",),
                            "PRECISE": (("navigation", "static"),),
                            "TABLE_GRADES": ("perfect", "navigation", "ADIS in-run")}.items():
            short.setattr(study, name, value)
        study.main(["--out", str(out), "--seeds", "1", "--workers", "1"])
    return out


def _table(text, title):
    """Return the rows of the first table below a heading, the header first."""
    lines = text.split(f"## {title}")[1].split("\n## ")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]


def test_the_page_has_every_section_and_picture(page):
    text = (page / "ins_alignment.md").read_text(encoding="utf-8")
    for title in SECTIONS:
        assert f"## {title}" in text
    assert "nan" not in text
    shown = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert shown == [f"ins_alignment/{name}.png" for name in FIGURES]
    for name in shown:
        assert (page / name).stat().st_size > 10_000


def test_every_figure_asked_for_has_an_answer_and_every_claim_a_verdict(page):
    text = (page / "ins_alignment.md").read_text(encoding="utf-8")
    asked = _table(text, "Asked and got")[1:]
    assert len(asked) == 2 * len(study.ASKED) + 2 + 5 + len(study.STEP_LIMITS)
    assert len(_table(text, "The paper's claims")[1:]) == 12
    for row in asked + _table(text, "The paper's claims")[1:]:
        assert all(row)


def test_table_2_has_every_grade_and_noise(page):
    rows = _table((page / "ins_alignment.md").read_text(encoding="utf-8"), "Table 2 side by side")
    assert len(rows) == 1 + 3 * (1 + 3)
    assert all(len(row) == 7 for row in rows)


def test_the_formulas_of_table_3_are_the_papers():
    assert study.formula_counts() == {"EKF": 7378, "UKF": 7851, "IPEKF, p = 10": 6643, "IPEKF, p = 2": 1443}
    counted = study.true_counts()
    assert counted["IPEKF, p = 10"][1] > counted["EKF"][0] > counted["IPEKF, p = 10"][0]


def test_five_states_are_observable_and_three_of_ten_are_not():
    assert study.observable_states(5) == 5
    assert study.observable_states(10) == 7


def test_the_bound_without_noise_of_the_sensors_is_that_of_a_parabola(monkeypatch):
    """A heading error d makes the velocity g Omega cos L d t^2 / 2, one of three unknowns of a parabola."""
    monkeypatch.setattr(study, "DURATION", BOUND_DURATION)
    params = runs.told(GRADES["navigation"])
    for noise_std in study.NOISE_STDS:
        time, _ = study.still_bound("perfect", noise_std)
        closed_form = (2 * math.sqrt(180 / runs.RATE) * noise_std
                       / (params.local_gravity * params.north_rate * runs.ACCURACY)) ** 0.4
        assert time == pytest.approx(closed_form, rel=BOUND_PART)


def test_ipekf_is_ekf5_at_its_default_weights_and_not_at_larger_ones(monkeypatch):
    monkeypatch.setattr(study, "DURATION", DURATION)
    plain = study.one_run("ekf5", "navigation", 1e-2)
    usual, acting = (study.one_run("ipekf", "navigation", 1e-2, weight_ratio=ratio) for ratio in (1e-4, 1e-2))
    assert np.all(np.abs(usual.error - plain.error) < SAME * plain.std)
    assert np.max(np.abs(acting.error - plain.error) / plain.std) > 5 * SAME


def test_the_velocity_noise_is_not_kept():
    still = runs.stand_still(10.0)
    start = still.truth.q_nb_wxyz[0]
    params = runs.as_the_paper(GRADES["perfect"], 1e-2)
    quiet = runs.run("ekf5", still, still.imu, params, start, 1 * DEG)
    zero = runs.run("ekf5", still, still.imu, params, start, 1 * DEG, np.zeros((len(still.imu), 2)))
    np.testing.assert_array_equal(zero.error, quiet.error)


def test_sensors_have_the_noise_and_biases_that_they_should():
    still = runs.stand_still(STILL)
    errors = GRADES["tactical"]
    biases = []
    for seed in range(40):
        imu = runs.add_biases_and_noise(still.imu, errors, np.random.default_rng(seed))
        gyro = imu.gyro_b - still.imu.gyro_b
        biases.append(gyro.mean(axis=0))
    assert gyro.std() == pytest.approx(errors.gyro_noise_density * math.sqrt(runs.RATE), rel=NOISE_PART)
    spread = math.hypot(errors.gyro_bias_std, errors.gyro_noise_density / math.sqrt(STILL))
    low, high = runs.interval(np.mean(np.square(biases)), np.size(biases))
    assert low < spread ** 2 < high


def test_intervals_hold_what_they_say():
    squares = np.mean(np.random.default_rng(0).standard_normal((4000, 20)) ** 2, axis=1)
    low, high = np.array([runs.interval(square, 20) for square in squares]).T
    assert np.mean((low < 1) & (high > 1)) == pytest.approx(0.95, abs=0.01)
