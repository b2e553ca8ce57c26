# SPDX-License-Identifier: MIT
"""Sets a server up from its options: certificates, simulation, link, log, service, metrics, workers, page."""

import logging
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from protocol.network.endpoints import BadEndpoint
from protocol.network.exposure import unrestricted
from protocol.network.metrics_server import MetricsServer, metrics_address
from protocol.network.session import AddressInUse, ConnectionFailed
from protocol.network.web_address import hindrance, web_address
from protocol.refused import Refused
from sim_server.backends.compiler import CompileError, ahead
from sim_server.certificates.in_use import Certificates
from sim_server.checkpoint.file import Checkpoint, read
from sim_server.errors import InputError
from sim_server.network.link import ServerLink
from sim_server.network.native_copies import compile_ahead
from sim_server.recording.recorder import Recorder
from sim_server.recording.rotation import Rotation
from sim_server.recording.starts import earlier, started
from sim_server.scene.size_limits import SizeLimits
from sim_server.service.service import Service
from sim_server.service.supervisor import Supervisor
from sim_server.service.web_page import WebPage
from sim_server.simulation import Simulation
from sim_server.startup.options import Options


@dataclass(frozen=True)
class Checked:
    """What options stand for, as far as it shows before anything is built.

    page, metrics: host and port; None: there is none
    """

    certificates: Certificates
    page: tuple[str, int] | None
    rotation: Rotation
    metrics: tuple[str, int] | None
    checkpoint: Checkpoint | None
    limits: SizeLimits


def set_up(closing: ExitStack, o: Options) -> tuple[Service, Supervisor | None]:
    """Builds a server and starts what belongs to it; `closing` ends all of it. Raises InputError on bad input."""
    try:
        checked = check(o)
        ahead("recording/wire.cpp")
        compile_ahead()
        simulation = Simulation.load(o.scene, o.overrides, o.device, checked.limits)
        link = closing.enter_context(
            ServerLink(o.name, o.listen, o.connect, shared_memory=o.shared_memory, tls=checked.certificates.server)
        )
        recorder, supervisor = None, None
        if o.record is not None:
            recorder = closing.enter_context(_recorder(o.record, checked.rotation, simulation))
        if o.workers and not simulation.scene.integrator.explicit:  # which needs none
            supervisor = start_workers(closing, o, link, checked.certificates)  # they take a second to come
        service = make_service(o, simulation, link, recorder, checked.checkpoint)
        if checked.metrics is not None:
            _serve_metrics(closing, service, *checked.metrics)
    except AddressInUse as error:
        raise InputError(
            f"{error}; is another sim-server there? --listen tcp/127.0.0.1:7448 takes another port"
        ) from None
    except (BadEndpoint, ConnectionFailed, Refused, CompileError) as error:
        raise InputError(str(error)) from None
    _warn_of_exposure(o)
    if supervisor is not None:
        service.supervise(supervisor)
    if checked.page is not None:
        _start_page(closing, o, service, checked.certificates, *checked.page)
    return service, supervisor


def check(o: Options) -> Checked:
    """Checks options and reads small files, before what takes long. Raises InputError, BadEndpoint or Refused."""
    certificates = Certificates(o.tls, o.listen, o.connect, o.insecure, workers=o.workers > 0, web=o.web is not None)
    page = None if o.web is None else _page_address(o.web)
    rotation = Rotation.of_options(o.record_rotate, o.record_keep)
    if (o.record_rotate or o.record_keep) and o.record is None:
        raise InputError("--record-rotate and --record-keep go with --record")
    metrics = None if o.metrics is None else metrics_address(o.metrics)
    checkpoint = None if o.resume is None else read(o.resume)
    return Checked(
        certificates, page, rotation, metrics, checkpoint, SizeLimits.of_options(o.max_objects, o.max_memory)
    )


def _page_address(web: str) -> tuple[str, int]:
    """Returns host and port of the page. Raises InputError if it cannot be served there."""
    host, port = web_address(web)
    if why := hindrance(host, port):
        raise InputError(f"--web: {why}")
    return host, port


def _recorder(record: Path, rotation: Rotation, simulation: Simulation) -> Recorder:
    """Opens the log. Raises InputError if it would replace something else, or cannot be written."""
    path, rotation = started(record), replace(rotation, earlier=tuple(earlier(record)))
    if path.is_file() and path.stat().st_size:
        with path.open("rb") as file:
            if file.read(8) != b"\x89MCAP0\r\n":
                raise InputError(f"--record {path}: this file exists and is no MCAP log; it is left as it is")
    compression = simulation.scene.record.compression
    return Recorder(path, compression, overwrite=True, report=logging.error, rotation=rotation)


def make_service(
    o: Options, simulation: Simulation, link: ServerLink, recorder: Recorder | None, checkpoint: Checkpoint | None
) -> Service:  # fmt: skip
    """Builds the service, from a checkpoint if there is one. Raises InputError."""
    try:
        return Service(simulation, link, recorder, o.steps, o.realtime, checkpoint)
    except InputError as error:
        raise InputError(f"--resume {o.resume}: {error}" if o.resume else str(error)) from None


def _serve_metrics(closing: ExitStack, service: Service, host: str, port: int) -> None:
    """Serves metrics until `closing` closes. Raises Refused if they cannot be served there."""
    from sim_server.service.metrics import ServerMetrics  # prometheus_client is there only where it is wanted

    names = [body.name for body in service.simulation.world.bodies]
    found = ServerMetrics(names, service.link, service.recorder, lambda: service.need.lost)
    closing.enter_context(MetricsServer(host, port, found, service.health.why_not))
    service.telemetry.metrics = found
    service.telemetry.publish_status("running")


def _warn_of_exposure(o: Options) -> None:
    for endpoint in unrestricted([*(o.listen or []), *(o.connect or [])], o.tls is not None):
        logging.warning(
            "--insecure: %s: anybody who reaches it may stop this server, and push, grab and pause; docs/security.md "
            "tells how to keep others out", endpoint
        )  # fmt: skip


def start_workers(closing: ExitStack, o: Options, link: ServerLink, certificates: Certificates) -> Supervisor:
    """Starts the local workers, which end with `closing`."""
    options = ["--device", o.worker_device, *certificates.for_worker]
    if not link.shared_memory:  # which was told, once
        options.append("--no-shared-memory")
    supervisor = Supervisor(o.workers, o.name, [certificates.local_endpoint], options)
    closing.callback(supervisor.close)
    return supervisor


def _start_page(
    closing: ExitStack, o: Options, service: Service, certificates: Certificates, host: str, port: int
) -> None:  # fmt: skip
    page = WebPage(o.name, certificates.local_endpoint, host, port, quiet=o.quiet, options=certificates.for_client)
    closing.callback(page.close)
    service.check_page = page.check
