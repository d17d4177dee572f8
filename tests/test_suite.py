"""What holds across the scripts: each stands alone, in the same words, and installs as it says."""

import ast
import itertools
import re
import sys
from pathlib import Path

import pytest
from conftest import ALGORITHMS, ROOT
from packaging.requirements import Requirement

SCRIPTS = sorted(ALGORITHMS.glob("*.py"))
README = (ROOT / "README.md").read_text(encoding="utf-8")
OWN = {"Args", "main"}  # each script's own
ROOMS = ["Args", "problem", "memory", "network", "algorithm", "evaluation", "report", "main"]


def definitions(path: Path) -> dict[str, str]:
    """Source of every top-level class and function, by name."""
    source = path.read_text(encoding="utf-8")
    found = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            decorators = "".join(ast.unparse(decorator) for decorator in node.decorator_list)
            found[node.name] = decorators + ast.get_source_segment(source, node)
    return found


def pep_723_block(path: Path) -> list[Requirement]:
    """The dependencies of a script's own block (PEP 723)."""
    lines = path.read_text(encoding="utf-8").splitlines()
    start = lines.index("# /// script")
    block = "\n".join(line[2:] for line in lines[start + 1 : lines.index("# ///", start)])
    assert 'requires-python = ">=3.10"' in block
    return [Requirement(text) for text in re.findall(r'"([^"]+)"', block.split("dependencies")[1])]


def pinned() -> list[Requirement]:
    """requirements.txt; every line says why."""
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    assert all(re.fullmatch(r"[\w.-]+==[^#]+ # \S.*", line) for line in lines), lines
    return [Requirement(line.split("#")[0]) for line in lines]


def test_same_name_same_source():
    first = {}
    for path in SCRIPTS:
        for name, source in definitions(path).items():
            if name not in OWN:
                owner, expected = first.setdefault(name, (path.name, source))
                assert source == expected, f"{name} differs between {owner} and {path.name}"


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
class TestEveryScript:
    def test_its_requirements_are_pinned(self, path):
        for requirement in pep_723_block(path):
            pins = [str(pin.specifier)[2:] for pin in pinned() if pin.name == requirement.name]
            assert pins and all(map(requirement.specifier.contains, pins)), requirement

    def test_it_imports_what_it_says_and_no_other_script(self, path):
        modules = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules.add(node.module.split(".")[0])
        assert not modules & {script.stem for script in SCRIPTS}
        known_as = {"cv2": "opencv-python-headless", "ale_py": "ale-py", "PIL": "pillow"}
        named = {requirement.name.lower() for requirement in pep_723_block(path)}
        assert {known_as.get(m, m) for m in modules if m not in sys.stdlib_module_names} <= named

    def test_its_rooms_stand_in_order(self, path):
        text = path.read_text(encoding="utf-8")
        banners = re.findall(r"^# ---- (\w+).*-$", text, re.MULTILINE)
        assert banners == [room for room in ROOMS if room in banners], banners
        assert {"Args", "algorithm", "main"} <= set(banners)

    def test_public_names_and_flags_have_docstrings(self, path):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert len(ast.get_docstring(tree).splitlines()) <= 40
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                assert ast.get_docstring(node), node.name
        (args,) = [node for node in tree.body if getattr(node, "name", None) == "Args"]
        for node, after in itertools.pairwise([*args.body, None]):
            if isinstance(node, ast.AnnAssign):
                assert isinstance(after, ast.Expr), ast.unparse(node)
                assert isinstance(after.value.value, str), ast.unparse(node)


def test_readme_pictures_are_there():
    links = re.findall(r"\]\(([^)#:]+)\)|src=\"([^\":]+)\"", README)
    assert links and all((ROOT / link).exists() for link in map("".join, links)), links
