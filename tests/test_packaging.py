"""What an installed Tapetum is: a wheel that works alone, typed, with a README that stands on a package index."""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

import tapetum

ROOT = Path(__file__).parents[1]


def test_its_type_hints_are_published():
    assert (Path(tapetum.__file__).parent / "py.typed").is_file()


def test_it_runs_as_a_module():
    ran = subprocess.run([sys.executable, "-m", "tapetum", "--version"], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", ran.stdout)


def test_the_readme_links_to_nothing_that_a_package_index_lacks():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    # A picture of the repository is shown in a clone; an index shows its text instead.
    pictures = re.findall(r"!\[.{20,}?\]\(([^)]+)\)", text, re.DOTALL)
    assert all((ROOT / one).is_file() for one in pictures)
    targets = re.findall(r"(?<!!)\[[^\]]*\]\(([^)]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    assert [one for one in targets if not one.startswith(("https://", "#"))] == []
    assert "pip install tapetum" in text and "download.pytorch.org/whl/cpu" in text and "2.6 GB" in text


@pytest.mark.slow
def test_a_wheel_works_in_a_fresh_environment(tmp_path: Path):
    """All but the wheel itself comes from the environment of the tests, so that nothing large is downloaded."""
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(tmp_path), str(ROOT)]
    built = subprocess.run(build, capture_output=True, text=True, check=False)
    if built.returncode and "hatchling" in built.stderr:
        pytest.skip("the build backend is not to be had here")
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("tapetum-*.whl")
    assert wheel.stat().st_size < 40e6
    fresh = tmp_path / "fresh"
    venv.create(fresh, with_pip=False)
    python = fresh / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--quiet", "--python", str(python), "install", "--no-deps", str(wheel)]
    subprocess.run(install, check=True)
    (site,) = fresh.glob("lib/python*/site-packages")
    (site / "shared.pth").write_text(sysconfig.get_paths()["purelib"] + "\n", encoding="utf-8")

    def run(*command: str | Path) -> str:
        told = subprocess.run(
            [str(one) for one in command], capture_output=True, text=True, check=True, cwd=tmp_path, env={"PATH": ""}
        )
        return told.stdout

    where = "import tapetum as tp; print(tp.__file__); print(tp.pretrained().target_names)"
    lines = run(python, "-c", where).splitlines()
    assert Path(lines[0]).is_relative_to(fresh) and lines[1] == "('gaze_x', 'gaze_y')"
    assert (site / "tapetum" / "py.typed").is_file()
    assert run(fresh / "bin" / "tapetum", "--version") == run(python, "-m", "tapetum", "--version")
    run(fresh / "bin" / "tapetum", "simulate", "thin-lens", "--set", "probe.sensor.pixels=[32, 32]", "-o", "rr.npy")
    assert (tmp_path / "rr.npy").is_file()
