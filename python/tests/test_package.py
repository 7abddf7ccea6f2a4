"""The package as it is: types, and a notebook that runs."""

import subprocess
import sys

import proprio
from conftest import TREE

PACKAGE = TREE / "python"


def test_types_are_strict(tmp_path):
    """Those of the package, and the pages' programs that use them."""
    programs = []
    for page in (PACKAGE / "README.md", TREE / "docs/book/src/read/python.md"):
        for program in page.read_text().split("```python\n")[1:]:
            path = tmp_path / f"program_{len(programs)}.py"
            path.write_text(program.split("```")[0])
            programs.append(str(path))
    assert len(programs) >= 3
    for paths in [[str(PACKAGE / "src" / "proprio")], *([program] for program in programs)]:
        command = [sys.executable, "-m", "mypy", "--config-file", str(PACKAGE / "pyproject.toml")]
        done = subprocess.run([*command, *paths], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stdout


def test_the_version_is_the_packages():
    import importlib.metadata

    assert proprio.__version__ == importlib.metadata.version("proprio")


def test_the_command_is_in_the_package():
    done = subprocess.run(
        [sys.executable, "-c", "from proprio._program import main; main()", "--version"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout.startswith("proprio "), done.stderr


def test_the_notebook_runs(tmp_path):
    import nbclient
    import nbformat

    notebook = nbformat.read(PACKAGE / "examples" / "torques.ipynb", as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()
    text = nbformat.writes(notebook)
    assert "image/png" in text and "<iframe" in text
    assert "Nothing was identified" not in text and "identified parameters" in text
    assert proprio.__doc__
