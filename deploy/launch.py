# SPDX-License-Identifier: MIT
"""Starts several servers and a pool of workers that they share, for one scene whose objects are distributed by size.

Objects do not interact, so that each may be on any server. Servers are called sim-0, sim-1, ... and listen on
consecutive ports; every worker serves all of them, a job of each in turn. Of several GPUs each process gets one, in
turn, first the servers, then the workers. Ctrl-C stops everything.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.network.endpoints import BadEndpoint, check_endpoint, on_this_machine
from protocol.process.command_line import Program, Terminated, end_in_order
from protocol.process.own_python import own_module
from protocol.refused import Refused
from sim_server.certificates.in_use import Certificates
from sim_server.errors import InputError
from sim_server.scene import Scene, load
from sim_server.service.supervisor import Supervisor, worker_process

PROGRAM = Program("launch")
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

EPILOG = """\b
Examples:
  .venv/bin/python deploy/launch.py deploy/scenes/four_beams.toml --servers 2 --workers 1
        two servers of two beams each, one worker for both
  .venv/bin/python deploy/launch.py scene.toml --servers 4 --workers 8 --port 7500 --record logs --steps 5000
        ports 7500 to 7503, logs/sim-0.mcap to logs/sim-3.mcap
  .venv/bin/python deploy/launch.py scene.toml --servers 2 --host 0.0.0.0 --json
        open to other hosts, where precond-worker --server sim-0@tcp/HOST:7447 --server sim-1@tcp/HOST:7448 may help;
        prints as JSON what runs
  sim-client status --connect tcp/127.0.0.1:7448 --server sim-1
        asks the second of them
"""

END_TIMEOUT = 5.0  # s for a server to end after SIGTERM
VISIBLE = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class Part:
    """What one server simulates: indices of objects in the scene, and the number of their tetrahedra."""

    objects: tuple[int, ...]
    tets: int


def distribute(tets: Sequence[int], servers: int) -> list[Part]:
    """Distributes objects of `tets` tetrahedra to at most `servers` servers, none of which is empty.

    The largest object is first, each goes to the server that has least. Within a server the order is that of the scene.
    """
    groups: list[list[int]] = [[] for _ in range(min(servers, len(tets)))]
    loads = [0] * len(groups)
    for index in sorted(range(len(tets)), key=lambda i: (-tets[i], i)):
        least = min(range(len(groups)), key=lambda k: (loads[k], len(groups[k])))
        groups[least].append(index)
        loads[least] += tets[index]
    return [Part(tuple(sorted(group)), load) for group, load in zip(groups, loads, strict=True)]


def toml(value: Any) -> str:
    """Writes a value of JSON types in TOML, on one line, without entries that are null, which TOML does not have."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value) if isinstance(value, float) else json.dumps(value)  # str writes inf and nan as TOML does


def part_of(scene: Scene, part: Part) -> str:
    """Writes the scene file of a part."""
    table = scene.resolved()
    table["object"] = [table["object"][index] for index in part.objects]
    contact, names = table["effects"].get("contact"), {o["name"] for o in table["object"]}
    if contact and contact["friction"]:
        obstacles = {o["name"] for o in table["obstacle"]}
        contact["friction"] = [pair for pair in contact["friction"] if {*pair["between"]} <= names | obstacles]
    return "".join(f"{key} = {toml(value)}\n" for key, value in table.items())


def installed_gpus() -> int:
    """Returns the number of GPUs that nvidia-smi lists; 0 where it does not run."""
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return 0
    return sum(line.startswith("GPU ") for line in listed.stdout.splitlines()) if listed.returncode == 0 else 0


def usable_gpus(environment: Mapping[str, str]) -> list[str]:
    """Returns the GPUs that may be used, as in CUDA_VISIBLE_DEVICES: those that it lists if it is set, else all."""
    listed = environment.get(VISIBLE)
    if listed is None:
        return [str(k) for k in range(installed_gpus())]
    names = [name.strip() for name in listed.split(",")]
    unusable = (k for k, name in enumerate(names) if not name or name.startswith("-"))
    return names[: next(unusable, len(names))]  # CUDA ignores those from the first malformed one on


def distribute_gpus(pool: Sequence[str], servers: int, workers: int) -> tuple[list[str | None], list[str | None]]:
    """Returns the GPU of each server and of each worker in turn; None where there is no choice."""
    if len(pool) < 2:
        return [None] * servers, [None] * workers
    dealt: list[str | None] = [pool[k % len(pool)] for k in range(servers + workers)]
    return dealt[:servers], dealt[servers:]


def environment_with(gpu: str | None) -> dict[str, str] | None:
    """Returns the environment of a process that sees this GPU only; None: that of this process."""
    return None if gpu is None else {**os.environ, VISIBLE: gpu}


class Fleet:
    """All servers and workers. Use it as a context manager: they end with it. host: with protocol, as tcp/127.0.0.1."""

    def __init__(self, scene: Scene, parts: Sequence[Part], host: str, port: int, record: Path | None, quiet: bool):
        self._scene, self._parts, self._record, self._quiet = scene, parts, record, quiet
        self._folder = tempfile.TemporaryDirectory(prefix="warpfactor-")
        self.names = [f"sim-{k}" for k in range(len(parts))]
        self.listen = [f"{host}:{port + k}" for k in range(len(parts))]
        self.endpoints = [on_this_machine(endpoint) for endpoint in self.listen]
        self.gpus: list[str | None] = [None] * len(parts)  # of the servers
        self.worker_gpus: dict[str, str | None] = {}
        self.servers: list[subprocess.Popen[bytes]] = []
        self.workers: Supervisor | None = None

    def start(self, workers: int, server_options: Sequence[str], worker_options: Sequence[str]) -> None:
        """Starts the servers, then the workers, which wait for them."""
        for name, listen, part, gpu in zip(self.names, self.listen, self._parts, self.gpus, strict=True):
            path = Path(self._folder.name) / f"{name}.toml"
            path.write_text(part_of(self._scene, part))
            record = ["--record", str(self._record / f"{name}.mcap")] if self._record else []
            command = own_module("sim_server", str(path), "--name", name, "--listen", listen)
            out = sys.stderr if self._quiet else None
            command += [*record, *server_options]
            self.servers.append(subprocess.Popen(command, stdout=out, env=environment_with(gpu)))
        if workers:
            first, *others = [f"{n}@{e}" for n, e in zip(self.names, self.endpoints, strict=True)]
            also = [word for server in others for word in ("--server", server)]
            self.workers = Supervisor(workers, first, [], [*also, *worker_options], start=self._start_worker)

    def _start_worker(self, command: Sequence[str]) -> "subprocess.Popen[bytes]":
        """Starts a worker, on the same GPU each time."""
        return worker_process(command, environment_with(self.worker_gpus.get(command[command.index("--name") + 1])))

    def use_gpus(self, pool: Sequence[str], servers: bool, workers: int) -> None:
        """Distributes GPUs to the servers, if `servers`, and to `workers` workers. Before `start`."""
        count = len(self._parts)
        mine, others = distribute_gpus(pool, count * servers, workers)
        self.gpus = mine or [None] * count
        self.worker_gpus = {f"local-{k + 1}": gpu for k, gpu in enumerate(others)}

    def describe(self) -> dict[str, Any]:
        """Returns what was started, for JSON."""
        names = [o.name for o in self._scene.objects]
        servers = [
            {
                "name": name, "pid": process.pid, "endpoint": endpoint, "tets": part.tets, "gpu": gpu,
                "objects": [names[index] for index in part.objects],
                "record": str(self._record / f"{name}.mcap") if self._record else None,
            }
            for name, endpoint, part, process, gpu in zip(
                self.names, self.endpoints, self._parts, self.servers, self.gpus, strict=True
            )
        ]  # fmt: skip
        pool = self.workers.local_workers() if self.workers else []
        return {
            "scene": str(self._scene.path),
            "servers": servers,
            "workers": [
                {"name": w.worker, "pid": w.pid, "servers": self.names, "gpu": self.worker_gpus.get(w.worker)}
                for w in pool
            ],
        }

    def wait(self) -> int:
        """Waits until all servers have ended, or one failed; returns its exit code."""
        while True:
            codes = [process.poll() for process in self.servers]
            if failed := [code for code in codes if code]:
                return failed[0]
            if all(code == 0 for code in codes):
                return 0
            if self.workers:
                self.workers.check()
            time.sleep(0.05)

    def close(self) -> None:
        """Ends all processes by SIGTERM, which completes logs; after END_TIMEOUT by SIGKILL."""
        for process in self.servers:
            if process.poll() is None:
                process.terminate()
        end = time.monotonic() + END_TIMEOUT
        for process in self.servers:
            try:
                process.wait(max(0.01, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self.workers:
            self.workers.close()
        self._folder.cleanup()

    def __enter__(self) -> "Fleet":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@app.command(epilog=EPILOG)
def launch(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What to simulate")],
    servers: Annotated[int, typer.Option(metavar="N", min=1, max=64, help="Servers to share its objects")] = 2,
    workers: Annotated[int, typer.Option(metavar="M", min=0, max=64, help="Workers, shared by all servers")] = 1,
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="Where servers listen")] = "127.0.0.1",
    port: Annotated[int, typer.Option(metavar="P", min=1, max=65535, help="Of the first server")] = 7447,
    device: Annotated[str, typer.Option(metavar="auto|cpu|gpu", help="Of the servers")] = "auto",
    worker_device: Annotated[str, typer.Option(metavar="auto|cpu|gpu", help="Of the workers")] = "cpu",
    threads: Annotated[int, typer.Option(metavar="T", min=1, help="Of each worker")] = 1,
    steps: Annotated[int | None, typer.Option(metavar="N", min=1, help="Stop after N steps")] = None,
    realtime: Annotated[bool, typer.Option("--realtime/--free-run", help="Keep pace with the clock or not")] = True,
    record: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write a log of each server there")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE|@FILE", help="Another value than the scene's, or a file of them"),
    ] = None,
    tls: Annotated[
        str | None, typer.Option(metavar="DIR", help="Ask for certificates; the folder that sim-server certs made")
    ] = None,
    insecure: Annotated[bool, typer.Option("--insecure", help="Let everybody in, also from other machines")] = False,
    json_: Annotated[bool, typer.Option("--json", help="Print what was started as JSON on one line")] = False,
) -> None:
    """Start N servers and M workers from one scene; its objects are distributed by size."""
    end_in_order()
    protocol = "tcp" if tls is None else "tls"
    try:
        whole = load(scene, set_ or [])
        parts = distribute([len(o.load_mesh().tets) for o in whole.objects], servers)
        last = check_endpoint(f"{protocol}/{host}:{port + len(parts) - 1}", listen=True)
        Certificates(tls, [last], None, insecure, workers=workers > 0, web=False)
        if record:
            record.mkdir(parents=True, exist_ok=True)
    except (InputError, BadEndpoint, Refused, OSError) as error:
        PROGRAM.bad_input(str(error))
    for_servers = ["--device", device, "--realtime" if realtime else "--free-run"]
    for_servers += ["--steps", str(steps)] if steps else []
    for_servers += ["--tls", tls] if tls else []
    for_servers += ["--insecure"] if insecure else []
    try:
        with Fleet(whole, parts, f"{protocol}/{host}", port, record, json_) as fleet:
            if "gpu" in (device, worker_device):
                fleet.use_gpus(usable_gpus(os.environ), device == "gpu", workers if worker_device == "gpu" else 0)
            of_workers = ["--tls", tls] if tls else []
            fleet.start(workers, for_servers, ["--device", worker_device, "--threads", str(threads), *of_workers])
            say(fleet.describe(), servers, json_)
            raise typer.Exit(fleet.wait())
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    except Terminated:
        raise typer.Exit(0) from None


def say(started: dict[str, Any], asked: int, as_json: bool) -> None:
    """Prints which process runs where."""
    if as_json:
        print(json.dumps(started), flush=True)
        return
    if len(started["servers"]) < asked:
        print(f"launch: {len(started['servers'])} of {asked} servers, one for each object", flush=True)
    for s in started["servers"]:
        shown = ", ".join(s["objects"][:6]) + (", ..." if len(s["objects"]) > 6 else "")
        count = f"{len(s['objects'])} object{'s' * (len(s['objects']) > 1)}"
        where = f"{s['endpoint']}, pid {s['pid']}{on_gpu(s)}"
        print(f"launch: {s['name']} at {where}: {count}, {s['tets']} tets ({shown})", flush=True)
    for w in started["workers"]:
        print(f"launch: worker {w['name']}, pid {w['pid']}{on_gpu(w)}, for all servers", flush=True)


def on_gpu(process: dict[str, Any]) -> str:
    """Words the GPU of a process; empty if it has none of its own."""
    return "" if process["gpu"] is None else f", GPU {process['gpu']}"


if __name__ == "__main__":
    app(prog_name="deploy/launch.py")
