# SPDX-License-Identifier: MIT
"""sim-client materials: the list, one material with its sources, JSON, a name that is not there."""

import json

import pytest

from clients.errors import BadInput
from clients.materials.show import show
from protocol import materials


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "240")


def test_the_list_has_all_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    show(None, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    for name in materials.names():
        (row,) = [line for line in lines if line.split()[:1] == [name]]
        assert materials.read(name)["law"] in row


def test_one_has_its_range_and_its_sources(capsys: pytest.CaptureFixture[str]) -> None:
    show("liver", as_json=False)
    out = capsys.readouterr().out
    assert "https://doi.org/10.1002/hep.24694" in out and "density 1060 kg/m3" in out
    (row,) = [line.split() for line in out.splitlines() if line.split()[:1] == ["young"]]
    assert row == ["young", "3200", "5630", "8500"]


def test_json_is_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    show("brain", as_json=True)
    assert json.loads(capsys.readouterr().out) == {"name": "brain", **materials.read("brain")}
    show(None, as_json=True)
    assert [each["name"] for each in json.loads(capsys.readouterr().out)] == materials.names()


def test_a_name_that_is_not_there() -> None:
    with pytest.raises(BadInput, match=r"'livr': no such material; did you mean 'liver'\? \(known materials: brain, "):
        show("livr", as_json=False)
