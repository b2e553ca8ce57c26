# SPDX-License-Identifier: MIT
"""The virtual coupling of a haptic client, its scripted hand, and the count of delays."""

import math
from collections import deque

import numpy as np
import pytest

from clients.errors import BadInput
from clients.haptics.coupling import VirtualCoupling, largest_stiffness
from clients.haptics.device import ScriptedHand
from clients.haptics.latency import Latency
from protocol import messages_pb2 as pb

PERIOD = 1e-3


def pressed(tissue: float, stiffness: float, delay: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Force on a hand that goes 1 cm into tissue (its stiffness in N/m) and stays, and the place of the proxy.

    What the tissue exerts on the proxy comes `delay` periods late, and is held for ten.
    """
    coupling = VirtualCoupling(stiffness, delay * PERIOD, PERIOD)
    waiting: deque[float] = deque([0.0] * delay)
    felt, places, force = [], [], 0.0
    for k in range(steps):
        hand = -0.01 * min(1.0, k / 100)
        felt.append(coupling.update((0.0, hand, 0.0), (0.0, force, 0.0))[1])
        assert coupling.proxy is not None
        places.append(coupling.proxy[1])
        waiting.append(max(0.0, -tissue * coupling.proxy[1]))
        came = waiting.popleft()
        force = came if k % 10 == 0 else force
    return np.array(felt), np.array(places)


@pytest.mark.parametrize("tissue", [50.0, 300.0, 500.0])
@pytest.mark.parametrize("delay", [10, 30, 100])
def test_a_late_force_of_tissue_as_stiff_as_the_spring_comes_to_rest(tissue: float, delay: int) -> None:
    felt, places = pressed(tissue, 500.0, delay, 200 + 60 * delay)
    balanced = 0.01 / (1 / tissue + 1 / 500.0)  # two springs in a row
    assert felt[-50:] == pytest.approx(balanced, rel=1e-3)
    assert places[-1] == pytest.approx(-balanced / tissue, rel=1e-3)
    drag = 500.0 * delay * PERIOD * 0.1  # of the proxy that touches, while the hand moves
    assert felt.max() < 2 * balanced + drag and places.min() > -0.0101


def test_a_spring_in_the_air_gives_back_no_more_than_it_got() -> None:
    """Work on the hand over whole turns is not positive: there is nothing that could give energy."""
    coupling, work, hand = VirtualCoupling(1000.0, 0.01, PERIOD), 0.0, 0.0
    for k in range(4000):
        force = coupling.update((hand, 0.0, 0.0), (0.0, 0.0, 0.0))[0]
        now = 0.01 * math.sin(2 * math.pi * 3 * (k + 1) * PERIOD)
        work += force * (now - hand)
        hand = now
    assert -1.0 < work < 0.0


def test_the_stiffness_is_bounded_by_damping_and_period() -> None:
    assert largest_stiffness(1.0, 1e-3) == 2000.0
    VirtualCoupling(1999.0, 0.01, 1e-3, device_damping=1.0)
    with pytest.raises(BadInput, match=r"2000 N/m each 0\.001 s"):
        VirtualCoupling(2001.0, 0.01, 1e-3, device_damping=1.0)
    for wrong in ({"stiffness": 0.0}, {"delay": -1.0}, {"period": 0.0}, {"speed": 0.0}, {"stiffness": math.nan}):
        with pytest.raises(BadInput, match="above 0"):
            VirtualCoupling(**{"stiffness": 100.0, "delay": 0.01, **wrong})


def test_the_proxy_is_no_faster_than_its_obstacle() -> None:
    coupling = VirtualCoupling(1000.0, 0.001, PERIOD, speed=0.5)
    coupling.update((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for k in range(1, 20):
        coupling.update((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        assert coupling.proxy == pytest.approx((0.5 * PERIOD * k, 0.0, 0.0))


def test_a_scripted_hand_goes_and_comes_back() -> None:
    now = [10.0]
    hand = ScriptedHand((0.0, 1.0, 0.0), (0.0, -0.5, 0.0), 0.5, lambda: now[0])
    assert hand.position() == (0.0, 1.0, 0.0)
    now[0] = 11.0
    assert hand.position() == pytest.approx((0.0, 0.5, 0.0))
    now[0] = 12.0
    assert hand.position() == pytest.approx((0.0, 1.0, 0.0))
    hand.render((1.0, 2.0, 3.0))
    assert hand.felt == (1.0, 2.0, 3.0)


def batch(*steps: int, moves: tuple[tuple[int, int], ...] = (), client: str = "me") -> pb.Steps:
    """Steps, and (number, steps before) of moves that were taken up."""
    found = pb.Steps(steps=[pb.ObjectStep(step=step) for step in steps])
    for number, before in moves:
        found.moves.add(client=client, obstacle="tool", move=number, step=before)
    return found


def test_delays_are_from_each_move_to_the_first_step_made_with_it_or_a_newer_one() -> None:
    latency = Latency("me", "tool", dt=0.01)
    latency.came(batch(7), 0.0)
    for number, at in ((1, 0.001), (2, 0.002), (3, 0.003)):
        latency.sent(number, at)
    latency.came(batch(8, moves=((2, 8),)), 0.010)  # step 8 was made without it
    latency.came(batch(8, moves=((5, 8),), client="other"), 0.011)
    assert latency.result()["moves"] == 0
    latency.came(batch(9), 0.022)
    found = latency.result()
    assert found["moves"] == 2 and found["ms_max"] == pytest.approx(21.0) and found["ms_p50"] == pytest.approx(20.5)
    assert found["steps_late_max"] == 2
    latency.came(batch(12, moves=((3, 11),)), 0.052)
    found = latency.result()
    assert (found["moves"], found["missing"], found["steps"]) == (3, 2, 4)
    assert found["steps_late_max"] == 5 and found["ms_max"] == pytest.approx(49.0)
    assert found["jitter_ms_max"] == pytest.approx(2.0) and found["steps_per_second"] == pytest.approx(3 / 0.052)
