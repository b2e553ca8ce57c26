# SPDX-License-Identifier: MIT
"""Films and stills of logs: what is in view, what lies in front, light, hands and time."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from clients.log.reader import Log
from clients.viewer.film import HAND, Angle, Stage, gif
from clients.viewer.painter import Camera, Piece, ball, paint, rod
from protocol import messages_pb2 as pb
from sim_server.recording.recorder import Recorder
from tests.sample_run import DT, header, object_step, record, scene, state, topology

Image = pytest.importorskip("PIL.Image")
RED, BLUE = np.array((230.0, 20, 20)), np.array((20.0, 20, 230))


def pixels(picture) -> np.ndarray:
    return np.asarray(picture.convert("RGB")).astype(int)


def share(picture: np.ndarray, channel: int) -> float:
    """Part of the pixels in which this channel is the strongest by far."""
    others = [c for c in range(3) if c != channel]
    return float((picture[..., channel] > picture[..., others].max(axis=-1) + 60).mean())


def test_the_nearer_body_hides_the_other() -> None:
    near, far = ball(np.array((0, 0, 1.0)), 0.5, RED), ball(np.array((0, 0, -1.0)), 0.4, BLUE)
    front = Camera(np.array((0, 0, 8.0)), np.zeros(3))
    for pieces in ([near, far], [far, near]):
        seen = pixels(paint(pieces, front, (80, 80)))
        assert share(seen, 0) > 0.05 and share(seen, 2) == 0
    back = Camera(np.array((0, 0, -8.0)), np.zeros(3))
    assert share(pixels(paint([near, far], back, (80, 80))), 2) > 0.02


def test_all_of_a_box_is_in_view_from_everywhere() -> None:
    low, high = np.array((-1.0, 0, -2)), np.array((3.0, 1, 0.5))
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    for azimuth in range(0, 360, 30):
        camera = Camera.around(low, high, azimuth, 20, aspect=1.2)
        place, depth = camera.seen(corners, 240, 200)
        assert (depth > 0).all() and (place > 0).all() and (place < (240, 200)).all()


def test_light_comes_from_above_and_casts_a_shadow() -> None:
    white = ball(np.array((0, 1.0, 0)), 0.5, (200, 200, 200))
    camera = Camera(np.array((0, 1.0, 8)), np.array((0, 0.8, 0)))
    seen = pixels(paint([white], camera, (120, 120), floor=0.0))
    empty = pixels(paint([Piece(white.x, white.triangles[:0], white.color)], camera, (120, 120), floor=0.0))
    body = np.abs(seen - empty).sum(axis=-1) > 0
    rows = np.flatnonzero(body[:, 55:65].any(axis=1))
    top, bottom = (seen[rows[0] + 8, 60], seen[rows[0] + 25, 60])
    assert top.sum() > bottom.sum()
    darker = (seen.sum(axis=-1) < empty.sum(axis=-1) - 30) & (np.arange(120) > 85)[:, None]
    assert darker.sum() > 40


def test_a_rod_is_closed_all_around() -> None:
    for end in ((0, 1, 0), (1, 0, 0), (0.3, -0.5, 0.7)):
        piece = rod(np.zeros(3), np.array(end, float), 0.1, RED)
        p = piece.x[piece.triangles]
        outward = np.einsum(
            "ij,ij->i", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), p.mean(axis=1) - piece.x.mean(axis=0)
        )
        assert (outward > 0).all()


def with_a_hand(path: Path) -> Path:
    """A body that stands still; from step 3 to 5 a client holds it and pulls to the right."""
    known = scene(["beam"])
    known.resolved = '{"object": [{"name": "beam"}]}'
    grab = pb.Interaction(id=5, client="c", object="beam", kind="grab", target=pb.Vector(x=2.5, y=0.5, z=0.5), nodes=1)
    with Recorder(path) as recorder:
        recorder.scene(known)
        recorder.topology(topology("beam"))
        for step in range(8):
            recorder.state(state("beam", 0) if step == 0 else _still(step), block=True)
            recorder.step(object_step("beam", step + 1), block=True)
            if step in (2, 5):
                sent = [pb.Interaction.FromString(grab.SerializeToString())] if step == 2 else []
                for i in sent:
                    i.held, i.offsets = np.array([4], "<i4").tobytes(), np.zeros(3).tobytes()
                message = pb.TouchSet(header=header(), step=step, interactions=sent)
                recorder.touch_set(message, step * DT)
    return path


def _still(step: int) -> pb.State:
    message = state("beam", 0)
    message.step, message.time, message.header.sequence = step, step * DT, step
    return message


def test_a_hand_is_there_while_it_holds(tmp_path: Path) -> None:
    with Log(with_a_hand(tmp_path / "run.mcap")) as log:
        stage = Stage(log, (160, 120))
        seen = [pixels(stage.draw(step * DT, caption=False)) for step in range(8)]
    apart = [int(np.abs(picture - seen[0]).max()) for picture in seen]
    assert [difference > 50 for difference in apart] == [False] * 3 + [True] * 3 + [False] * 2
    colour = np.array(HAND)[None, None]
    assert (np.abs(seen[3] / np.maximum(seen[3].sum(axis=-1, keepdims=True), 1) - colour / colour.sum()) < 0.05).any()


def with_a_ball(path: Path, shown: bool) -> Path:
    """A body that stands still, and in front of it a ball that rises by 0.3 m a step."""
    place = {"position": pb.Vector(x=0.5, y=0.2, z=1.2), "rotation": pb.Quaternion(w=1)}
    with Recorder(path) as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(topology("beam"))
        if shown:
            recorder.obstacle(
                pb.Obstacle(header=header("ball"), shape="sphere", size=[0.15], moved="keyframes", **place)
            )
        for step in range(3):
            recorder.state(_still(step), block=True)
            place["position"].y = 0.2 + 0.3 * step
            if shown:
                pose = pb.ObstaclePose(header=header("ball"), step=step, time=step * DT, **place)
                recorder.pose(pose, block=True)
    return path


def test_obstacles_are_where_their_poses_are(tmp_path: Path) -> None:
    seen = []
    for shown in (False, True):
        with Log(with_a_ball(tmp_path / f"{shown}.mcap", shown)) as log:
            stage = Stage(log, (160, 120), Angle(nearness=0.8))
            seen.append([pixels(stage.draw(step * DT, caption=False)) for step in range(3)])
    different = [np.abs(with_it - without).max(axis=-1) > 30 for without, with_it in zip(*seen, strict=True)]
    tops = [int(np.flatnonzero(picture.any(axis=1)).min()) for picture in different]
    assert tops[1] < tops[0] - 5 and tops[2] < tops[1] - 5


def test_a_film_has_as_many_pictures_as_its_time(tmp_path: Path) -> None:
    with Log(record(tmp_path / "run.mcap", 20)) as log:
        film = Image.open(BytesIO(gif(log, 0.1, 0.4, rate=20, size=(96, 80))))
        late = Image.open(BytesIO(gif(log, 0.3, 9, rate=20, size=(96, 80))))
    assert (film.n_frames, late.n_frames, film.size) == (7, 3, (96, 80))
    assert film.info["duration"] == 50 and film.info["loop"] == 0
    first = pixels(film)
    film.seek(6)
    assert np.abs(pixels(film) - first).max() > 50
