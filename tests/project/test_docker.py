"""What is in docker/ is valid, complete, pinned, unprivileged and not exposed, as far as one sees it here."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import yaml

from tests.project.documentation import ROOT

DOCKER = ROOT / "docker"
MANIFESTS = sorted((DOCKER / "k8s").glob("*.yaml"))
COMPOSE_SCHEMA = ["--builtin-schema", "vendor.compose-spec"]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
TEXT = {"type": "string"}
TEXTS = {"type": "object", "additionalProperties": TEXT}
WHOLE = {"type": "integer", "minimum": 0}
ANYTHING: dict[str, object] = {}


def fields(required: tuple[str, ...] = (), /, **properties: object) -> dict[str, object]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


# The fields of KubeRay's RayJob that are of use here, named after its API reference (ray.io/v1, KubeRay 1.7):
# a misspelt field is one that is not here. Pod templates are Kubernetes' own, and held against its schema.
GROUP = {"rayStartParams": TEXTS, "template": fields(("spec",), metadata=ANYTHING, spec=ANYTHING)}
RAY_JOB = fields(
    ("apiVersion", "kind", "metadata", "spec"),
    apiVersion={"const": "ray.io/v1"},
    kind={"const": "RayJob"},
    metadata=fields(("name",), name=TEXT, namespace=TEXT, labels=TEXTS, annotations=TEXTS),
    spec=fields(
        ("entrypoint", "rayClusterSpec"),
        activeDeadlineSeconds=WHOLE,
        backoffLimit=WHOLE,
        entrypoint=TEXT,
        entrypointNumCpus={"type": "number"},
        runtimeEnvYAML=TEXT,
        shutdownAfterJobFinishes={"type": "boolean"},
        submissionMode={"enum": ["K8sJobMode", "HTTPMode", "InteractiveMode", "SidecarMode"]},
        submitterConfig=fields(backoffLimit=WHOLE),
        submitterPodTemplate=GROUP["template"],
        suspend={"type": "boolean"},
        ttlSecondsAfterFinished=WHOLE,
        rayClusterSpec=fields(
            ("headGroupSpec",),
            authOptions=fields(("mode",), mode={"enum": ["disabled", "token"]}, secretName=TEXT),
            enableInTreeAutoscaling={"type": "boolean"},
            headGroupSpec=fields(
                ("template",), serviceType={"enum": ["ClusterIP", "NodePort", "LoadBalancer"]}, **GROUP
            ),
            rayVersion=TEXT,
            workerGroupSpecs={
                "type": "array",
                "items": fields(
                    ("groupName", "template"),
                    groupName=TEXT,
                    replicas=WHOLE,
                    minReplicas=WHOLE,
                    maxReplicas=WHOLE,
                    **GROUP,
                ),
            },
        ),
    ),
)


def tool(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def compose() -> dict[str, Any]:
    """The compose file with its defaults filled in."""
    text = re.sub(r"\$\{\w+(?::-([^}]*))?\}", r"\1", (DOCKER / "compose.yaml").read_text())
    parsed = yaml.safe_load(text)
    assert isinstance(parsed, dict)
    return parsed


SERVICES: Mapping[str, Mapping[str, Any]] = compose()["services"]
OURS = tuple(name for name, service in SERVICES.items() if "build" in service)
RAY = tuple(name for name in OURS if name != "mlflow")


def test_the_dockerfile_has_no_finding() -> None:
    done = tool("hadolint", str(DOCKER / "Dockerfile"))
    assert (done.returncode, done.stdout) == (0, "")


def test_the_image_holds_every_package_and_nothing_secret() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    ignored = (DOCKER / "Dockerfile.dockerignore").read_text().splitlines()
    for folder in ("src", *(link.name for link in (ROOT / "src" / "recrl").iterdir() if link.is_symlink())):
        assert f"COPY {folder} {folder}\n" in text
        assert f"!{folder}" in ignored
    assert next(line for line in ignored if not line.startswith("#")) == "*"
    assert not any("secrets" in line or ".env" in line for line in ignored if line.startswith("!"))
    assert re.findall(r"^USER (.*)$", text, re.MULTILINE) == ["10001:10001"]
    assert not re.search(r"TOKEN=|PASSWORD", text)
    assert f"recrl:{VERSION}" in text


def test_base_images_have_exact_versions() -> None:
    bases = re.findall(r"^ARG PYTHON_IMAGE=(.*)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    bases += [service["build"]["args"]["PYTHON_IMAGE"] for service in SERVICES.values() if "build" in service]
    bases += [SERVICES["postgres"]["image"]]
    assert len(set(bases)) == 2
    for base in bases:
        assert re.search(r":\d+\.\d+(\.\d+)?-[a-z-]+(@sha256:[0-9a-f]{64})?$", base), base


def test_the_compose_file_fits_its_schema(tmp_path: Path) -> None:
    done = tool("check-jsonschema", *COMPOSE_SCHEMA, str(DOCKER / "compose.yaml"))
    assert done.returncode == 0, done.stdout
    wrong = tmp_path / "compose.yaml"
    wrong.write_text((DOCKER / "compose.yaml").read_text().replace("healthcheck:", "healthchek:"))
    assert tool("check-jsonschema", *COMPOSE_SCHEMA, str(wrong)).returncode == 1


def test_everything_that_a_service_names_is_there() -> None:
    whole = compose()
    for name, service in SERVICES.items():
        assert set(service["networks"]) <= set(whole["networks"]), name
        assert set(service.get("depends_on", ())) <= set(SERVICES), name
        assert set(service.get("secrets", ())) <= set(whole["secrets"]), name
        assert all(SERVICES[needed]["healthcheck"] for needed in service.get("depends_on", ())), name
        for volume in service.get("volumes", ()):
            source = volume.partition(":")[0]
            assert source in whole["volumes"] or source in ("../runs", "../grids"), name
    used = {network for service in SERVICES.values() for network in service["networks"]}
    assert used == set(whole["networks"])
    assert {secret for service in SERVICES.values() for secret in service.get("secrets", ())} == set(
        whole["secrets"]
    )
    assert (ROOT / "grids/demo.yaml").exists()
    for host, port in re.findall(
        r"([a-z-]+):(\d+)", json.dumps([s.get("command") for s in SERVICES.values()])
    ):
        assert host in (*SERVICES, "localhost") or port in ("", "0"), f"{host}:{port}"


@pytest.mark.parametrize("name", SERVICES)
def test_no_container_has_any_privilege(name: str) -> None:
    service = SERVICES[name]
    assert service["user"] == "10001:10001"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not {"privileged", "cap_add", "devices", "pid", "ipc", "network_mode"} & set(service)
    assert not any("docker.sock" in volume for volume in service.get("volumes", ()))
    assert service["image"].rpartition(":")[2] not in ("", "latest")


def test_only_mlflow_is_published_and_only_to_this_machine() -> None:
    assert {name for name, service in SERVICES.items() if "ports" in service} == {"mlflow"}
    assert SERVICES["mlflow"]["ports"] == ["127.0.0.1:5000:5000"]
    assert not any("expose" in service for service in SERVICES.values())


def test_ray_and_the_database_are_on_networks_that_lead_nowhere() -> None:
    networks = compose()["networks"]
    for name in (*RAY, "postgres"):
        assert all(networks[network]["internal"] for network in SERVICES[name]["networks"]), name
    assert not set(SERVICES["postgres"]["networks"]) & set(SERVICES["ray-worker"]["networks"])


def test_every_ray_process_starts_with_a_token_and_without_a_dashboard() -> None:
    for name in RAY:
        assert SERVICES[name]["command"][0] == "recrl-node"
        assert SERVICES[name]["environment"]["RAY_AUTH_MODE"] == "token"
        assert SERVICES[name]["environment"]["RAY_AUTH_TOKEN_PATH"] == "/run/secrets/ray_token"
        assert "ray_token" in SERVICES[name]["secrets"]
    starts = re.findall(r"ray start .*", (DOCKER / "recrl-node").read_text())
    assert len(starts) == 3
    assert [start for start in starts if "--head" in start and "--include-dashboard=false" not in start] == []


def test_no_secret_is_a_variable_or_an_argument() -> None:
    for name, service in SERVICES.items():
        for key, value in service.get("environment", {}).items():
            if re.search("TOKEN|PASS|SECRET|KEY", key):
                assert str(value).startswith("/run/secrets/") or key == "RAY_AUTH_MODE", f"{name}: {key}"
        for argument in service.get("command", ()):
            assert not re.search(r"://[^/@]*:[^/@]*@", argument), f"{name}: {argument}"


def test_mlflow_checks_the_host_it_is_asked_for() -> None:
    [hosts] = [
        argument for argument in SERVICES["mlflow"]["command"] if argument.startswith("--allowed-hosts=")
    ]
    assert hosts.partition("=")[2].split(",") == ["mlflow:5000", "localhost:*", "127.0.0.1:*"]
    assert not any("disable" in argument for argument in SERVICES["mlflow"]["command"])


def test_the_launch_shares_its_results_with_the_workers() -> None:
    runs = {name for name, service in SERVICES.items() if "../runs:/runs" in service.get("volumes", ())}
    assert runs == {"ray-worker", "sweep"}
    assert "--root=/runs" in SERVICES["sweep"]["command"]
    assert SERVICES["sweep"]["profiles"] == ["sweep"]


def test_secrets_are_made_once_for_this_user_alone_and_never_committed(tmp_path: Path) -> None:
    shutil.copytree(DOCKER, tmp_path / "docker", ignore=shutil.ignore_patterns("secrets", ".env"))
    texts = []
    for _ in range(2):
        subprocess.run([tmp_path / "docker/prepare"], check=True, capture_output=True)
        secrets = sorted((tmp_path / "docker/secrets").iterdir())
        assert {path.name for path in secrets} == set(compose()["secrets"])
        assert {stat.S_IMODE(path.stat().st_mode) for path in secrets} == {0o600}
        texts.append({path.name: path.read_text() for path in secrets})
    assert texts[0] == texts[1]
    assert re.fullmatch("[0-9a-f]{64}", texts[0]["ray_token"])
    assert texts[0]["pgpass"] == f"postgres:5432:mlflow:recrl:{texts[0]['postgres_password']}\n"
    assert not re.search("^RECRL_UID=0$", (tmp_path / "docker/.env").read_text(), re.MULTILINE)
    assert (DOCKER / ".gitignore").read_text().split() == [".env", "secrets/"]


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Any]:
    """A function that runs recrl-node with a ``ray`` that only says how it was called."""
    for name, text in (("ray", 'echo ray "$@"'), ("hostname", "echo 10.0.0.7 172.18.0.2")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "token").write_text("secret")
    (tmp_path / "empty").touch()
    right = {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN_PATH": str(tmp_path / "token"),
        "RECRL_HEAD": "head:6379",
    }

    def run(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        variables = {**right, "PATH": f"{tmp_path}:/usr/bin:/bin", **variables}
        command = ["sh", str(DOCKER / "recrl-node"), *arguments]
        return subprocess.run(command, env=variables, capture_output=True, text=True, check=False)

    yield run


def test_no_node_starts_without_its_token(node: Any) -> None:
    for role in ("head", "worker", "run"):
        for wrong in (
            {"RAY_AUTH_MODE": "disabled"},
            {"RAY_AUTH_MODE": ""},
            {"RAY_AUTH_TOKEN_PATH": ""},
            {"RAY_AUTH_TOKEN_PATH": "/nowhere"},
        ):
            done = node(role, "true", **wrong)
            assert (done.returncode, done.stdout) == (2, "")
            assert re.fullmatch(r"recrl-node: RAY_AUTH_(MODE|TOKEN_PATH) must .*, got '.*'\n", done.stderr)
    assert node("heads").stderr == "recrl-node: say head, worker or run COMMAND, got 'heads'\n"
    assert node("run").stderr == "recrl-node: say what to run\n"


def test_nodes_start_as_what_they_are(node: Any) -> None:
    own = "--node-ip-address=10.0.0.7 --disable-usage-stats --object-store-memory=100000000\n"
    head = "ray start --head --block --port=6379 --num-cpus=0 --include-dashboard=false"
    assert node("head").stdout == f"{head} {own}"
    worker = "ray start --block --address=head:6379 --num-cpus=4"
    assert node("worker", RECRL_CPUS="4").stdout == f"{worker} {own}"
    launch = "ray start --address=head:6379 --num-cpus=0"
    assert node("run", "echo", "two words", "end").stdout == f"{launch} {own}two words end\n"


def documents() -> list[dict[str, Any]]:
    return [document for path in MANIFESTS for document in yaml.safe_load_all(path.read_text())]


def pods(job: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The pod templates of a RayJob, as pods."""
    cluster = job["spec"]["rayClusterSpec"]
    templates = {
        "submitter": job["spec"]["submitterPodTemplate"],
        "head": cluster["headGroupSpec"]["template"],
        **{group["groupName"]: group["template"] for group in cluster["workerGroupSpecs"]},
    }
    return {
        name: {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, **template["metadata"]}}
        | {"spec": template["spec"]}
        for name, template in templates.items()
    }


[JOB] = [document for document in documents() if document["kind"] == "RayJob"]


def test_the_manifests_fit_kubernetes_schemas() -> None:
    version = kubernetes_validate.latest_version()
    for document in [*(d for d in documents() if d["kind"] != "RayJob"), *pods(JOB).values()]:
        kubernetes_validate.validate(document, version, strict=True)
    with pytest.raises(kubernetes_validate.ValidationError):
        wrong = {**pods(JOB)["head"], "spec": {**pods(JOB)["head"]["spec"], "volumess": []}}
        kubernetes_validate.validate(wrong, version, strict=True)


def test_the_ray_job_has_only_fields_that_kuberay_knows() -> None:
    jsonschema.validate(JOB, RAY_JOB)
    for wrong in ({"backofLimit": 3}, {"submissionMode": "K8sJob"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**JOB, "spec": {**JOB["spec"], **wrong}}, RAY_JOB)


@pytest.mark.skipif(
    "KUBERAY_CRD" not in os.environ, reason="KUBERAY_CRD does not name KubeRay's ray.io_rayjobs.yaml"
)
def test_the_ray_job_fits_kuberays_own_definition() -> None:
    definition = yaml.load(Path(os.environ["KUBERAY_CRD"]).read_text(), Loader=yaml.CSafeLoader)
    [version] = [
        each for each in definition["spec"]["versions"] if f"ray.io/{each['name']}" == JOB["apiVersion"]
    ]
    schema = closed(version["schema"]["openAPIV3Schema"])
    schema["properties"]["metadata"] = {}  # Kubernetes' own
    jsonschema.validate(JOB, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**JOB, "spec": {**JOB["spec"], "backofLimit": 3}}, schema)


def closed(schema: Any) -> Any:
    """A definition of Kubernetes' as a JSON schema that forbids what it does not name."""
    if isinstance(schema, list):
        return [closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("x-kubernetes-int-or-string"):
        return {}
    found = {key: closed(value) for key, value in schema.items()}
    open_ended = found.get("x-kubernetes-preserve-unknown-fields") or "additionalProperties" in found
    return found if open_ended or "properties" not in found else {**found, "additionalProperties": False}


def test_the_ray_job_is_of_this_version_and_wants_a_token() -> None:
    cluster = JOB["spec"]["rayClusterSpec"]
    assert cluster["authOptions"] == {"mode": "token"}
    assert f"\nray=={cluster['rayVersion']}\n" in (ROOT / "constraints.txt").read_text()
    images = {container["image"] for pod in pods(JOB).values() for container in pod["spec"]["containers"]}
    assert images == {SERVICES[name]["image"] for name in OURS} == {f"recrl:{VERSION}"}
    assert cluster["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"


@pytest.mark.parametrize("name", pods(JOB))
def test_no_pod_has_any_privilege(name: str) -> None:
    spec = pods(JOB)[name]["spec"]
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    for container in spec["containers"]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert set(container["resources"]) == {"requests", "limits"}
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted == {volume["name"] for volume in spec["volumes"]}


def test_pods_find_what_they_mount_and_strangers_find_no_port() -> None:
    kinds = {document["kind"]: document for document in documents()}
    [claim] = {
        volume["persistentVolumeClaim"]["claimName"]
        for pod in pods(JOB).values()
        for volume in pod["spec"]["volumes"]
        if "persistentVolumeClaim" in volume
    }
    assert kinds["PersistentVolumeClaim"]["metadata"]["name"] == claim
    assert kinds["PersistentVolumeClaim"]["spec"]["accessModes"] == ["ReadWriteMany"]
    guarded = kinds["NetworkPolicy"]["spec"]["podSelector"]["matchLabels"].items()
    for pod in pods(JOB).values():
        assert guarded <= pod["metadata"]["labels"].items()
    assert not any("Ingress" in kind or kind == "Service" for kind in kinds)
