"""`headway browse` on a machine with other users: access, writing, files."""

import hashlib
import json
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import quote

import pytest
from browse_server import answer, browse_server, cookie_of
from command_lines import refused
from mlflow_server import free_port

from headway.store.run_folder import now
from headway.store.tracking.client import Tracker, database_path
from headway_launch.commands import browse
from headway_launch.commands.browse import _listen

API = "/mlflow/ajax-api/2.0/mlflow"
SECRET = "what only its owner may read"


class Store(SimpleNamespace):
    """A store that is served, with two runs: one has links to private files, the other is stored outside."""

    root: Path
    address: str
    cookie: str
    run: str
    outside: str
    experiment: str

    def read(self, path: str, **headers: str) -> tuple[int, str]:
        """Answer to a request of the user who has the token."""
        return answer(self.address, path, Cookie=self.cookie, **headers)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("shared machine")
    private = folder / "private"
    private.mkdir()
    (private / "secret.txt").write_text(SECRET)
    (folder / "note.txt").write_text("a result")
    root = folder / "runs"
    tracker = Tracker(root)
    experiment, parent = tracker.cell("study", "cell", {}, {})
    run = tracker.child(experiment, parent, "run", now(), {}, {})
    tracker.finish(run, "FINISHED", now(), {"final_reward": 1.0}, [folder / "note.txt"])
    artifacts = root / "mlflow-artifacts" / run / "artifacts"
    (artifacts / "link.txt").symlink_to(private / "secret.txt")
    (artifacts / "folder").symlink_to(private)
    elsewhere = tracker._ask("create_experiment", "outside", artifact_location=private.as_uri())
    outside = tracker._ask("create_run", elsewhere).info.run_id
    (private / outside / "artifacts").mkdir(parents=True)
    (private / outside / "artifacts" / "secret.txt").write_text(SECRET)
    with browse_server(root) as address:
        yield Store(
            root=root, address=address, cookie=cookie_of(address), run=run, outside=outside,
            experiment=experiment,
        )  # fmt: skip


def contents(root: Path) -> dict[str, str]:
    """Digest of each file of a store."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    ["/", "/report/study", "/mlflow/", "/mlflow/static-files/manifest.json", f"{API}/experiments/search"],
)
def test_nothing_is_served_without_the_token(store: Store, path: str) -> None:
    name, _, token = store.cookie.partition("=")
    wrong = "x" * len(token)
    assert store.read(path)[0] != 403
    for headers in (
        {},
        {"Cookie": f"{name}={wrong}"},
        {"Cookie": f"{name}="},
        {"Cookie": f"token={token}"},
        {"Authorization": f"Bearer {token}"},
        {"Authorization": f"token {token}"},
        {"Token": token},
        {"X-Token": token},
    ):
        assert answer(store.address, path, **headers)[0] == 403, headers
    for query in (wrong, "", token[:-1], token + "x", "%C3%A9", "%00"):
        assert answer(store.address, f"{path}?token={query}")[0] == 403, query


@pytest.mark.slow
def test_pages_of_other_servers_of_the_machine_read_nothing(store: Store) -> None:
    own = store.address.partition("/?")[0]
    assert store.read("/", Origin=own)[0] == 200
    for origin in (f"http://127.0.0.1:{free_port()}", "http://localhost", "http://example.org", "null"):
        assert store.read("/", Origin=origin)[0] == 403, origin


@pytest.mark.slow
def test_a_forwarded_port_may_have_another_number(store: Store) -> None:
    for host in ("127.0.0.1:9999", "localhost:9999"):
        assert store.read("/mlflow/", Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.slow
def test_nothing_is_written(store: Store) -> None:
    before = contents(store.root)
    run, experiment = {"run_id": store.run}, {"experiment_id": store.experiment}
    writes = [
        ("POST", "experiments/create", {"name": "new"}),
        ("POST", "experiments/delete", experiment),
        ("POST", "experiments/update", {**experiment, "new_name": "other"}),
        ("POST", "experiments/set-experiment-tag", {**experiment, "key": "k", "value": "v"}),
        ("POST", "runs/create", experiment),
        ("POST", "runs/delete", run),
        ("POST", "runs/update", {**run, "status": "FAILED"}),
        ("POST", "runs/set-tag", {**run, "key": "k", "value": "v"}),
        ("POST", "runs/log-metric", {**run, "key": "m", "value": 1.0, "timestamp": 1}),
        ("POST", "runs/log-batch", {**run, "tags": [{"key": "k", "value": "v"}]}),
        ("POST", "registered-models/create", {"name": "model"}),
        ("DELETE", "registered-models/delete", {"name": "model"}),
        ("POST", f"upload-artifact?run_uuid={store.run}&path=new.txt", {}),
    ]
    for method, name, body in writes:
        for api in ("/mlflow/api", "/mlflow/ajax-api", "/api", "/ajax-api"):
            status, _ = answer(
                store.address, f"{api}/2.0/mlflow/{name}", method, json.dumps(body), Cookie=store.cookie,
                **{"Content-Type": "application/json"},
            )  # fmt: skip
            assert status in (403, 404), (method, name, status)
    for method in ("PUT", "DELETE", "PATCH", "POST"):
        for path in ("/mlflow/api", "/api", "/mlflow/ajax-api"):
            name = f"{path}/2.0/mlflow-artifacts/artifacts/{store.run}/artifacts/note.txt"
            assert answer(store.address, name, method, "new", Cookie=store.cookie)[0] in (403, 404)
        status, _ = answer(store.address, "/mlflow/get-artifact", method, "{}", Cookie=store.cookie)
        assert status == 405
    assert contents(store.root) == before


@pytest.mark.slow
def test_searching_is_no_writing(store: Store) -> None:
    body = json.dumps({"experiment_ids": [store.experiment]})
    json_body = {"Content-Type": "application/json"}
    status, text = answer(store.address, f"{API}/runs/search", "POST", body, Cookie=store.cookie, **json_body)
    assert status == 200
    assert store.run in text


@pytest.mark.slow
def test_files_outside_the_store_are_not_served(store: Store) -> None:
    def artifact(path: str, run: str = store.run) -> tuple[int, str]:
        return store.read(f"/mlflow/get-artifact?run_id={run}&path={path}")

    assert artifact("note.txt") == (200, "a result")
    secret = quote(str(store.root.parent / "private" / "secret.txt"), safe="")
    climbing = "../../../../private/secret.txt"
    for path in (
        "link.txt",
        "folder/secret.txt",
        climbing,
        quote(climbing, safe=""),
        secret,
        f"file://{secret}",
    ):
        status, text = artifact(path)
        assert status in (400, 403, 404), path
        assert SECRET not in text
    status, text = artifact("secret.txt", store.outside)
    assert status == 403
    assert SECRET not in text
    _, text = store.read(f"/mlflow/get-artifact?run_uuid={store.outside}&path=secret.txt")
    assert SECRET not in text


@pytest.mark.slow
def test_folders_outside_the_store_are_not_listed(store: Store) -> None:
    assert "note.txt" in store.read(f"{API}/artifacts/list?run_id={store.run}")[1]
    for query in (f"run_id={store.run}&path=folder", f"run_id={store.outside}"):
        status, text = store.read(f"{API}/artifacts/list?{query}")
        assert status == 403, query
        assert "secret.txt" not in text
    body = json.dumps({"run_id": store.outside})
    headers = {"Content-Type": "application/json", "Cookie": store.cookie}
    status, text = answer(store.address, f"{API}/artifacts/list", "GET", body, **headers)
    assert status == 403
    assert "secret.txt" not in text


@pytest.mark.slow
def test_a_store_without_runs_has_a_page(store: Store) -> None:
    status, text = store.read("/")
    assert status == 200
    assert "no runs yet" in text


def test_errors_are_one_line(tmp_path: Path) -> None:
    assert "there is no store" in refused("browse", "--store", str(tmp_path / "absent"))
    assert "70000 is not a valid port" in refused("browse", "--store", str(tmp_path), "--port", "70000")
    port = free_port()
    listener = _listen(port)
    try:
        line = refused("browse", "--store", str(tmp_path), "--port", str(port))
    finally:
        listener.close()
    assert f"port {port} cannot be used" in line
    assert "another headway browse may be running" in line
    assert not database_path(tmp_path).exists()


def test_without_the_whole_of_mlflow_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def light(package: str) -> str:
        if package == "mlflow":
            raise PackageNotFoundError(package)
        return version(package)

    monkeypatch.setattr(browse, "version", light)
    assert refused("browse").strip().endswith('pip install "headway[browse]"')
