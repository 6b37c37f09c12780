"""The package as its users get it: what it says of itself agrees, its programs answer, its files exist."""

import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.machinery import SourceFileLoader
from importlib.metadata import entry_points, metadata

import pytest

from alignment.edge import AlignmentNodeParams
from attitude_estimator.edge import AttitudeNodeParams
from attitude_estimator.navigation.edge import NavigationNodeParams
from nav_ros import resources
from nav_ros.bags import read_recording
from nav_ros.parameters import load_parameter_file, parameter_names, params_from_values

PACKAGE = "attitude_alignment"
NODES = ("attitude_node", "alignment_node", "navigation_node", "replay_node")  # ROS programs have no --help
BAGS_LIMIT = 10e6  # bytes, so that a clone stays small
TILT_DEG = 0.05  # of the recipe in Python: ideal sensors that stand still
HELP_TIMEOUT = 60.0  # s, generous: only a program that hangs is late
# Not to be published: where a developer works, and what is not done.
UNWANTED = re.compile(r"/(?:root|home/\w+|tmp|work)/|\b(?:TODO|FIXME|XXX)\b")


def tracked_files(repository):
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=repository, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return [repository / name for name in listed.stdout.split("\0") if name]


def own_executables():
    """Return the names of the programs; those of the studies do their whole work when they are called."""
    return sorted(entry.name for entry in entry_points(group="console_scripts")
                  if entry.dist.name == PACKAGE and not entry.module.startswith("studies"))


@pytest.fixture(scope="module")
def manifest(repository):
    return ElementTree.parse(repository / "package.xml").getroot()


def readme_with_tables(repository):
    loader = SourceFileLoader("write_readme_tables", str(repository / "scripts" / "write_readme_tables"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module.with_tables


def test_the_recipe_in_python_finds_the_roll_of_its_table(repository, capsys):
    code = (repository / "docs" / "usage.md").read_text().split("```python\n")[1].split("```")[0]
    exec(compile(code, "docs/usage.md", "exec"), {})
    roll_deg, pitch_deg = re.match(r"roll (\S+), pitch (\S+), sigma", capsys.readouterr().out).groups()
    assert (float(roll_deg), float(pitch_deg)) == (pytest.approx(10.0, abs=TILT_DEG), pytest.approx(0.0, abs=TILT_DEG))


def test_readme_has_the_parameters_of_the_dataclasses(repository):
    text = (repository / "README.md").read_text(encoding="utf-8")
    with_tables = readme_with_tables(repository)
    assert with_tables(text) == text, "run `make readme`"
    for name in parameter_names(AttitudeNodeParams):
        assert f"| `{name}` |" in text
    changed = text.replace("| `gyro_bias_std` | ", "| `gyro_bias_std` | 9")
    assert changed != text and with_tables(changed) == text


def test_setup_and_manifest_agree(manifest):
    installed = metadata(PACKAGE)
    assert manifest.findtext("name") == installed["Name"]
    assert manifest.findtext("version") == installed["Version"]
    assert manifest.findtext("description") == installed["Summary"]
    assert manifest.findtext("license") == installed["License"]


def test_changelog_begins_with_this_version(repository, manifest):
    headings = re.findall(r"^(\d+\.\d+\.\d+) \(.*\)\n-+$", (repository / "CHANGELOG.rst").read_text(), re.M)
    assert headings[0] == manifest.findtext("version")


def test_manifest_names_every_ros_package_that_is_imported(repository, manifest):
    declared = {element.text for element in manifest if element.tag.endswith("depend")}
    folders = ("attitude_estimator", "alignment", "nav_ros", "studies")
    sources = [path.read_text(encoding="utf-8") for folder in folders
               for path in (repository / folder).rglob("*.py")]
    pattern = re.compile(r"^\s*(?:from|import) (\w+_msgs|\w+_srvs|rclpy|tf2_ros)\b", re.M)
    imported = {name for source in sources for name in pattern.findall(source)}
    assert "sensor_msgs" in imported
    assert imported <= declared


def test_manifest_and_setup_require_the_same_libraries(manifest):
    required = {re.match(r"[\w.-]+", text)[0] for text in metadata(PACKAGE).get_all("Requires-Dist")
                if "extra ==" not in text}
    keys = {element.text for element in manifest.findall("exec_depend") if element.text.startswith("python3-")}
    libraries = {key.removeprefix("python3-").removesuffix("-pip") for key in keys}
    assert libraries == required | {"matplotlib"}  # which draws reports; pip has it as an extra


@pytest.mark.parametrize("name", own_executables())
def test_executable_answers(name, tmp_path):
    arguments = ["--ros-args", "-p", "bag:=/there/is/no/bag", "-p", "estimator:=none",
                 "-p", "method:=none"] if name in NODES \
        else ["--help"]
    done = subprocess.run([resources.executable(name), *arguments], capture_output=True, text=True,
                          timeout=HELP_TIMEOUT, stdin=subprocess.DEVNULL, cwd=tmp_path)
    said = done.stdout + done.stderr
    assert "Traceback" not in said
    if name in NODES:  # a parameter that cannot be: one line, and the end
        assert done.returncode != 0 and any(
            text in said for text in ("no/bag", "estimator", "method"))
    else:
        assert done.returncode == 0 and f"usage: {name}" in said


def test_there_are_executables():
    assert {"attitude_node", "alignment_node", "navigation_node", "replay_node", "estimate_bag", "align_bag",
            "navigate_bag", "simulate_bag", "score_bag", "report_bag", "attitude_demo"} <= set(own_executables())


def test_bundled_bags(repository):
    names = sorted(path.name for path in (resources.share_folder() / "bags").iterdir())
    assert names == ["aerobatics", "hover", "turns", "turntable"]
    size = sum(path.stat().st_size for path in (repository / "bags").rglob("*") if path.is_file())
    assert 0 < size < BAGS_LIMIT
    for name in names:
        recording = read_recording(resources.bundled_bag(name))
        assert len(recording.imu) and len(recording.truth)
        assert (recording.altitude is None) == (name == "turntable")


@pytest.mark.parametrize("name", ["hover", "turntable"])
def test_make_bags_gives_the_same_bytes(repository, tmp_path, name):
    path = f"{resources.executable('simulate_bag').parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run([repository / "scripts" / "make_bags", tmp_path, name], check=True, capture_output=True,
                   env=os.environ | {"PATH": path})
    for bundled in (repository / "bags" / name).iterdir():
        assert (tmp_path / name / bundled.name).read_bytes() == bundled.read_bytes(), bundled.name


@pytest.mark.parametrize("name, node, kind", [("attitude.yaml", "attitude_node", AttitudeNodeParams),
                                              ("alignment.yaml", "alignment_node", AlignmentNodeParams),
                                              ("navigation.yaml", "navigation_node", NavigationNodeParams)])
def test_parameter_file_has_the_defaults(name, node, kind):
    values = load_parameter_file(resources.bundled_config(name), node, parameter_names(kind))
    assert "accel_bias_std" in values
    written = vars(params_from_values(kind, values))
    for parameter, default in vars(params_from_values(kind, {})).items():
        assert written[parameter] == pytest.approx(default, nan_ok=True), parameter


def test_unknown_resources_are_named():
    with pytest.raises(ValueError, match="turns"):
        resources.bundled_bag("missing")
    with pytest.raises(ValueError, match="attitude.yaml"):
        resources.bundled_config("missing.yaml")
    with pytest.raises(FileNotFoundError, match="missing_program"):
        resources.executable("missing_program")


def test_links_in_the_documents_exist(repository):
    documents = [repository / "README.md", *(repository / "docs").rglob("*.md")]
    links = [(document, link) for document in documents
             for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8"))]
    assert len(links) > 5
    missing = [f"{document.name}: {link}" for document, link in links
               if not link.startswith("http") and not (document.parent / link).exists()]
    assert not missing


def test_no_machine_paths_and_nothing_left_to_do(repository):
    found = [f"{path.relative_to(repository)}:{number}: {line.strip()}"
             for path in tracked_files(repository) if path.suffix not in (".mcap", ".png")
             and path.name != "test_package.py"
             for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
             if UNWANTED.search(line)]
    assert not found, "\n".join(found)


def test_python_is_supported():
    assert (3, 10) <= sys.version_info[:2] <= (3, 14)
