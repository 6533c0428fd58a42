"""The files of a public project agree with each other and with the package."""

import re
import tomllib
from pathlib import Path

import yaml

import vggtjax

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def _read(path: Path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_every_file_names_one_version_and_one_licence():
    citation, project = _read(ROOT / "CITATION.cff"), _project()
    assert vggtjax.__version__ == project["version"] == citation["version"]
    assert f"\n## {vggtjax.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert project["license"] == citation["license"]


def test_each_python_of_the_classifiers_is_tested():
    said = {line.split(" :: ")[-1] for line in _project()["classifiers"] if "Python :: 3." in line}
    matrix = _read(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["fast"]["strategy"]["matrix"]
    assert set(matrix["python"]) == said


def test_workflows_have_few_rights_and_pinned_actions():
    assert WORKFLOWS
    for path in WORKFLOWS:
        workflow = _read(path)
        assert workflow["permissions"] == {"contents": "read"}, path.name  # jobs that need more say so
        for name, job in workflow["jobs"].items():
            assert "uses" in job or job["timeout-minutes"] <= 180, f"{path.name}: {name}"
            for step in job.get("steps", []):
                if "actions/checkout@" in step.get("uses", ""):
                    assert step["with"]["persist-credentials"] is False, f"{path.name}: {name}"
        for used in re.findall(r"\buses: +(?!\./)(.*)", path.read_text(encoding="utf-8")):
            assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", used), f"{path.name}: {used}"


def test_workflows_run_what_the_makefile_has():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for path in (*WORKFLOWS, ROOT / "CONTRIBUTING.md"):
        called = set(re.findall(r"^\s*(?:- run: )?make (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE))
        assert called <= targets, path.name
