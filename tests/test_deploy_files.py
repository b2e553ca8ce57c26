# SPDX-License-Identifier: MIT
"""Image, compose file, chart and Slurm scripts: what they call is there, and what they promise is in them."""

import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from protocol.channels import DEFAULT_ENDPOINT
from tests.docs.test_commands import PROGRAMS

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
OPTIONS = {
    program: {option for p in PROGRAMS[heading].params for option in p.opts}
    for program, heading in (("sim-server", "sim-server SCENE.toml"), ("precond-worker", "precond-worker"))
}


def check_command(words: list[str]) -> None:
    """The program is one of ours, and has these options."""
    program, *rest = words
    used = {word.split("=")[0] for word in rest if word.startswith("--")}
    assert used <= OPTIONS[program], (program, used - OPTIONS[program])


# --- image ----------------------------------------------------------------------------------------------------------


def test_the_image_copies_what_there_is_and_its_context_has_it() -> None:
    text = (DEPLOY / "Containerfile").read_text()
    copied = [word for line in re.findall(r"^COPY (?!--)(.*)$", text, re.MULTILINE) for word in line.split()[:-1]]
    ignored = (DEPLOY / "Containerfile.dockerignore").read_text().splitlines()
    assert copied
    for name in copied:
        assert (ROOT / name).exists(), name
        assert f"!{name}" in ignored, f"{name} is left out of the context"
    packages = re.search(r"include = \[(.*)\]", (ROOT / "pyproject.toml").read_text())
    assert packages is not None
    assert {name.strip(' "*') for name in packages[1].split(",")} <= set(copied)


def test_the_image_runs_as_a_user_of_its_own_and_has_no_compiler() -> None:
    text = (DEPLOY / "Containerfile").read_text()
    last = text[text.rindex("FROM ") :]
    assert "USER 10001:10001" in last and "useradd --uid 10001" in last
    assert "g++" not in last and "--require-hashes" in text
    assert text.index("--no-build-isolation") < text.rindex("FROM ")
    command = re.search(r"^CMD \[(.*)\]", last, re.MULTILINE)
    assert command is not None
    check_command([word.strip(' "') for word in command[1].split(",")])


# --- compose --------------------------------------------------------------------------------------------------------


def compose() -> Any:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


def test_services_of_compose_are_hardened_and_call_what_there_is() -> None:
    services = compose()["services"]
    assert set(services) == {"server", "worker"}
    for service in services.values():
        check_command([word for word in service["command"] if not word.startswith("$")])
        assert service["user"] == "10001:10001" and service["read_only"] is True and service["cap_drop"] == ["ALL"]
        assert service["healthcheck"]["test"][0] == "CMD"
    assert services["server"]["healthcheck"]["test"][1:3] == ["sim-client", "status"]
    assert (ROOT / services["server"]["build"]["dockerfile"]).is_file()


def test_ports_of_compose_are_of_this_machine_alone() -> None:
    ports = compose()["services"]["server"]["ports"]
    assert ports and all(port.startswith("127.0.0.1:") for port in ports)


def test_workers_of_compose_share_memory_with_the_server() -> None:
    services = compose()["services"]
    assert services["worker"]["ipc"] == "service:server" and services["server"]["ipc"] == "shareable"
    assert services["worker"]["ulimits"]["memlock"] >= 1140850688


# --- chart ----------------------------------------------------------------------------------------------------------

TLS = ["--set", "tls.enabled=true"]
VARIANTS = {
    "plain": [],
    "pool": ["--set", "pool.workers=3"],
    "scaled": ["--set", "pool.scale.enabled=true", "--set", "server.log.size="],
    "tls": [*TLS, "--set", "pool.workers=1", "--set", "server.scene=a.toml", "--set", "server.scenes.a\\.toml=dt=0.1"],
}


def test_the_chart_has_what_charts_have() -> None:
    """Also without helm: names and values, and that templates ask for values that there are."""
    chart = yaml.safe_load((DEPLOY / "helm" / "Chart.yaml").read_text())
    assert chart["apiVersion"] == "v2" and chart["name"] == "warpfactor"
    values = yaml.safe_load((DEPLOY / "helm" / "values.yaml").read_text())
    asked = set()
    for template in (DEPLOY / "helm" / "templates").iterdir():
        text = template.read_text()
        assert text.count("{{") == text.count("}}"), template.name
        opened = len(re.findall(r"{{-?\s*(?:if|range|with|define)\b", text))
        assert opened == len(re.findall(r"{{-?\s*end\b", text)), template.name
        asked |= set(re.findall(r"\.Values\.([A-Za-z.]+)", text))
    for path in asked:
        found = values
        for part in path.split("."):
            assert part in found, f"values.yaml has no {path}"
            found = found[part]
    assert {"tls.serverSecret", "pool.scale.lost", "networkPolicy.clients", "server.sharedMemory"} <= asked


needs_helm = pytest.mark.skipif(shutil.which("helm") is None, reason="helm is not installed")


def rendered(variant: str) -> list[Any]:
    command = ["helm", "template", "t", str(DEPLOY / "helm"), "--kube-version", "1.31.0", *VARIANTS[variant]]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return [document for document in yaml.safe_load_all(done.stdout) if document]


def of(documents: list[Any], kind: str, name: str) -> Any:
    return next(d for d in documents if d["kind"] == kind and d["metadata"]["name"] == name)


@needs_helm
def test_helm_finds_nothing_wrong() -> None:
    done = subprocess.run(
        ["helm", "lint", "--strict", str(DEPLOY / "helm")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stdout


@needs_helm
@pytest.mark.parametrize("variant", VARIANTS)
def test_pods_call_what_there_is_and_are_hardened(variant: str) -> None:
    documents = rendered(variant)
    pods = [d["spec"]["template"]["spec"] for d in documents if d["kind"] in ("StatefulSet", "Deployment")]
    assert pods
    for pod in pods:
        assert pod["securityContext"]["runAsNonRoot"] is True
        volumes = {volume["name"] for volume in pod["volumes"]}
        for container in pod["containers"]:
            assert container["securityContext"]["readOnlyRootFilesystem"] is True
            assert container["livenessProbe"] and container["resources"]["limits"]["memory"]
            claims = {"log"} if variant != "scaled" else set()
            assert {mount["name"] for mount in container["volumeMounts"]} <= volumes | claims
            if container["name"] != "router":
                check_command(container["args"])
    policies = {d["metadata"]["name"] for d in documents if d["kind"] == "NetworkPolicy"}
    assert policies == ({"t-server"} if variant == "plain" else {"t-server", "t-pool", "t-router"})


@needs_helm
def test_a_worker_beside_each_server_shares_its_memory() -> None:
    pod = of(rendered("plain"), "StatefulSet", "t-server")["spec"]["template"]["spec"]
    assert [c["name"] for c in pod["containers"]] == ["server", "worker"]
    for container in pod["containers"]:
        assert {"name": "memory", "mountPath": "/dev/shm"} in container["volumeMounts"]
    memory = next(volume for volume in pod["volumes"] if volume["name"] == "memory")
    assert memory["emptyDir"]["medium"] == "Memory"


@needs_helm
def test_the_pool_scales_by_a_metric_that_there_is() -> None:
    documents = rendered("scaled")
    assert "replicas" not in of(documents, "Deployment", "t-pool")["spec"], "KEDA sets them"
    query = of(documents, "ScaledObject", "t-pool")["spec"]["triggers"][0]["metadata"]["query"]
    page = (ROOT / "docs" / "operations.md").read_text()
    assert re.findall(r"warpfactor_\w+", query) == ["warpfactor_need_seconds", "warpfactor_workers"]
    assert all(f"`{name}`" in page for name in re.findall(r"warpfactor_\w+", query))


@needs_helm
def test_with_certificates_nobody_gets_in_without() -> None:
    documents = rendered("tls")
    arguments = [a for d in documents if d["kind"] in ("StatefulSet", "Deployment")
                 for c in d["spec"]["template"]["spec"]["containers"] for a in c["args"]]  # fmt: skip
    assert "--insecure" not in arguments and arguments.count("--tls=/tls") == 3
    assert not any("tcp/" in argument for argument in arguments)


@needs_helm
@pytest.mark.parametrize("variant", VARIANTS)
def test_kubernetes_has_these_fields(variant: str, tmp_path: Path) -> None:
    validate = pytest.importorskip("kubernetes_validate")
    for document in rendered(variant):
        if document["kind"] != "ScaledObject":  # KEDA's own
            validate.validate(document, "1.31", strict=True)


# --- Slurm ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["server.sbatch", "pool.sbatch"])
def test_scripts_for_slurm_are_shell(name: str) -> None:
    assert subprocess.run(["bash", "-n", str(DEPLOY / "slurm" / name)], capture_output=True).returncode == 0


@pytest.mark.system
def test_a_job_of_slurm_runs_a_server_with_workers(tmp_path: Path) -> None:
    """srun and scontrol are played: they run the command here."""
    from tests.system.server_process import beam

    programs = Path(sys.prefix) / "bin"
    if not (programs / "sim-server").exists():
        pytest.skip("the programs are not installed here")
    for name, text in {
        "srun": 'while [[ "$1" == --* ]]; do shift; done; exec "$@"',
        "scontrol": "echo 127.0.0.1",
    }.items():
        path = tmp_path / name
        path.write_text(f"#!/usr/bin/env bash\n{text}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    log = tmp_path / "run.mcap"
    environment = {
        **os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "VENV": sys.prefix, "WORKERS": "1",
        "SLURM_JOB_ID": str(os.getpid()), "SLURM_JOB_NODELIST": "node[1-1]",
    }  # fmt: skip
    scene = beam(
        tmp_path, solver='update = "lockstep-2"'
    )  # waits for factors: without a worker it would not end so soon
    command = ["bash", str(DEPLOY / "slurm" / "server.sbatch"), str(scene), "--free-run", "--steps", "40", "--record"]
    done = subprocess.run([*command, str(log)], env=environment, cwd=ROOT, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    assert "40 steps" in done.stdout and log.stat().st_size > 0
    factors = re.search(r"(\d+) factors used", done.stdout)
    assert factors is not None and int(factors[1]) > 0
    assert "ready:" in done.stdout, "a worker was there"


def test_a_script_without_a_scene_says_what_it_wants() -> None:
    for name in ("server.sbatch", "pool.sbatch"):
        done = subprocess.run(["bash", str(DEPLOY / "slurm" / name)], capture_output=True, text=True)
        assert done.returncode == 2 and done.stderr.startswith("usage: sbatch")


# --- firewall -------------------------------------------------------------------------------------------------------


def test_the_firewall_limits_new_connections_to_the_default_port_by_address() -> None:
    path = DEPLOY / "nftables" / "warpfactor.nft"
    rules = [line.strip() for line in path.read_text().splitlines() if "dport" in line]
    assert len(rules) == 2
    for rule, source in zip(rules, ("ip saddr", "ip6 saddr"), strict=True):
        assert rule.startswith(f"tcp dport {DEFAULT_ENDPOINT.rpartition(':')[2]} ct state new update @")
        assert f"{{ {source} limit rate over 1/second burst 30 packets }} drop" in rule
    if (nft := shutil.which("nft")) is not None and os.geteuid() == 0:
        check = ["unshare", "-n", nft, "-c", "-f", str(path)]
        done = subprocess.run(check, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
