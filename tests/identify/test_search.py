# SPDX-License-Identifier: MIT
"""The search for parameters, with models that need no server: known answers, and a file from which it goes on."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clients.errors import BadInput, ClientError
from clients.identify.fits import Fit, fits
from clients.identify.search import Attempt, Search

TIMES = np.linspace(0, 1, 50)
YOUNG, DAMPING = Fit("young", 1e3, 1e7), Fit("damping", 0.0, 5.0)


def swing(young: float, damping: float) -> np.ndarray:
    """A damped oscillator about its sag: stiffness in the sag and the rate, as of a beam that is let go."""
    rate = np.sqrt(young / 1e3)
    return (np.exp(-damping * TIMES) * np.cos(rate * TIMES) - 1) / rate**2


def attempt_for(model: Callable[..., np.ndarray], **truth: float) -> Attempt:
    measured = model(**truth)
    return lambda values: (model(**values) - measured) / np.abs(measured).max() / np.sqrt(len(TIMES))


def test_one_parameter_is_found_in_few_runs(tmp_path: Path) -> None:
    """Over four decades, to 0.01 %."""
    attempt = attempt_for(lambda young: 1 / young * TIMES, young=3.21e5)
    found = Search(tmp_path / "runs", [YOUNG], 0, "q").run(attempt, 60)
    assert found.converged and found.runs <= 14
    assert found.values["young"] == pytest.approx(3.21e5, rel=1e-4)


@pytest.mark.parametrize("seed", [0, 1])
def test_two_parameters_with_local_minima_are_found(tmp_path: Path, seed: int) -> None:
    """Frequencies have those: steps that lead nowhere give way to tries elsewhere."""
    attempt = attempt_for(swing, young=4.4e4, damping=1.7)
    found = Search(tmp_path / "runs", [Fit("young", 1e4, 2e5), DAMPING], seed, "q").run(attempt, 100)
    assert found.values == pytest.approx({"young": 4.4e4, "damping": 1.7}, rel=1e-3)
    assert found.misfit < 1e-4


def test_a_search_that_was_interrupted_goes_on_as_if_it_had_not(tmp_path: Path) -> None:
    attempt, known = attempt_for(swing, young=4.4e4, damping=1.7), [YOUNG, DAMPING]
    seen: dict[str, list[dict[str, float]]] = {"whole": [], "parts": []}

    def noted(name: str) -> Attempt:
        def made(values: dict[str, float]) -> np.ndarray | str:
            if name == "parts" and len(seen[name]) == 5 and not interrupted:
                interrupted.append(True)
                raise KeyboardInterrupt
            seen[name].append(values)
            return attempt(values)

        return made

    interrupted: list[bool] = []
    whole = Search(tmp_path / "whole", known, 3, "q").run(noted("whole"), 12)
    with pytest.raises(KeyboardInterrupt):
        Search(tmp_path / "parts", known, 3, "q").run(noted("parts"), 12)
    assert Search(tmp_path / "parts", known, 3, "q").run(noted("parts"), 8).runs == 8
    parts = Search(tmp_path / "parts", known, 3, "q").run(noted("parts"), 12)
    assert seen["parts"] == seen["whole"] and parts == whole


def test_a_search_that_was_killed_before_a_run_began_goes_on_with_it(tmp_path: Path) -> None:
    attempt, known = attempt_for(swing, young=4.4e4, damping=1.7), [YOUNG, DAMPING]
    seen: dict[str, list[dict[str, float]]] = {"whole": [], "parts": []}

    def noted(name: str) -> Attempt:
        return lambda values: (seen[name].append(values), attempt(values))[1]

    Search(tmp_path / "whole", known, 0, "q").run(noted("whole"), 8)
    killed = Search(tmp_path / "parts", known, 0, "q")
    killed.run(noted("parts"), 2)

    def ask(*_: object) -> None:
        raise KeyboardInterrupt

    killed.study.ask = ask  # type: ignore[method-assign,assignment]
    with pytest.raises(KeyboardInterrupt):
        killed.run(noted("parts"), 8)
    Search(tmp_path / "parts", known, 0, "q").run(noted("parts"), 8)
    assert seen["parts"] == seen["whole"]


def test_runs_that_fail_are_left_out(tmp_path: Path) -> None:
    """Beyond a value the run diverges; the answer is on the other side."""
    good = attempt_for(lambda young: 1 / young * TIMES, young=2e4)
    found = Search(tmp_path / "runs", [YOUNG], 0, "q").run(lambda v: "diverged" if v["young"] > 8e4 else good(v), 60)
    assert found.values["young"] == pytest.approx(2e4, rel=1e-3)
    with pytest.raises(ClientError, match="none of 4 runs has come to its end; the last: diverged"):
        Search(tmp_path / "bad", [YOUNG], 0, "q").run(lambda v: "diverged", 4)


def test_an_answer_beyond_the_bounds_ends_at_one(tmp_path: Path) -> None:
    attempt = attempt_for(lambda young: 1 / young * TIMES, young=1e8)
    found = Search(tmp_path / "runs", [YOUNG], 0, "q").run(attempt, 40)
    assert found.values["young"] == pytest.approx(1e7, rel=1e-3)


def test_runs_of_another_question_and_other_files_are_refused(tmp_path: Path) -> None:
    Search(tmp_path / "runs", [YOUNG], 0, "one")
    with pytest.raises(BadInput, match=r"runs: has runs of another scene, other curves or bounds; --journal FILE"):
        Search(tmp_path / "runs", [YOUNG], 0, "other")
    (tmp_path / "text").write_text("a text\nof two lines\n")
    with pytest.raises(BadInput, match="text: cannot be used as the file of runs"):
        Search(tmp_path / "text", [YOUNG], 0, "one")


BAD_FITS = [
    (["young"], "must be KEY=LOW:HIGH"), (["young=1"], "must be KEY=LOW:HIGH"), (["young=2:1"], "the lower one first"),
    (["young=a:b"], "must be KEY=LOW:HIGH"), (["=1:2"], "needs a key"), (["a=0:inf"], "finite bounds"),
    (["a=1:2", "a=1:3"], "--fit a: is given twice"), ([], "0 times; allowed 1 to 20"),
]  # fmt: skip


@pytest.mark.parametrize(("texts", "message"), BAD_FITS)
def test_bad_fits_are_refused(texts: list[str], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        fits(texts)


def test_wide_bounds_are_logarithmic() -> None:
    wide, narrow = fits(["a=1e2:1e6", "b=1:3"])
    assert wide.value(0.5) == pytest.approx(1e4) and narrow.value(0.5) == pytest.approx(2)
    assert wide.share(wide.value(0.3)) == pytest.approx(0.3) == narrow.share(narrow.value(0.3))
