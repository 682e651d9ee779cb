"""The tutorials of the documents, run as they stand: their commands, their rules, their requests."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tests.live.pages import free_port

PAGE = Path(__file__).parents[2] / "docs" / "tutorials.md"
OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def section(title: str) -> str:
    """A tutorial's text."""
    found = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert found, title
    return found[1]


def blocks(text: str, kind: str) -> list[str]:
    found = re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)
    # Those of a numbered list are indented.
    return [re.sub(r"(?m)^ {3}", "", one) if one.startswith("   ") else one for one in found]


class Asked:
    """A served tutorial: runs its requests, at the port that is free here."""

    def __init__(self, port: int, text: str, process: subprocess.Popen[str]) -> None:
        self.base, self.process = f"http://127.0.0.1:{port}", process
        self.lines = [
            line for block in blocks(text, "sh") for line in block.strip().splitlines() if line.startswith("curl")
        ]

    def get(self, path: str) -> Any:
        with OPENER.open(f"{self.base}{path}", timeout=30) as answer:
            return json.load(answer)

    def run(self, part: str) -> Any:
        """Run the line of the tutorial that holds a text."""
        (line,) = (one for one in self.lines if part in one)
        words = shlex.split(line)[1:]
        options = {words[k]: words[k + 1] for k in range(0, len(words) - 1, 2)}
        body = options.get("-d")
        return self.post(
            words[-1].replace("http://127.0.0.1:8750", ""), None if body is None else body, options.get("-X", "GET")
        )

    def post(self, path: str, body: str | None, method: str = "POST") -> Any:
        headers = {} if body is None else {"content-type": "application/json"}
        data = None if body is None else body.encode()
        request = urllib.request.Request(f"{self.base}{path}", data, headers, method=method)
        with OPENER.open(request, timeout=30) as answer:
            said = answer.read()
        return json.loads(said) if said else None

    def until(self, path: str, holds: Callable[[Any], Any], seconds: float = 60) -> Any:
        end = time.monotonic() + seconds
        while not (found := holds(self.get(path))):
            assert time.monotonic() < end, f"{path}: {self.get(path)}"
            time.sleep(0.1)
        return found


@contextmanager
def served(title: str, folder: Path) -> Iterator[Asked]:
    text, port = section(title), free_port()
    for block in blocks(text, "yaml"):
        (folder / "guard.yaml").write_text(block, encoding="utf-8")
    (command,) = (one for one in blocks(text, "sh") if one.startswith("tapetum serve"))
    words = [sys.executable, "-m", *shlex.split(command), "--port", str(port)]
    process = subprocess.Popen(
        words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=dict(os.environ)
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://" in line, line + process.stdout.read()
        yield Asked(port, text, process)
    finally:
        process.terminate()
        process.wait(30)


@pytest.mark.slow
def test_watch_a_room(tmp_path: Path) -> None:
    with served("Watch a room", tmp_path) as room:
        room.until("/api/state", lambda now: len(now["cameras"]) >= 2)
        room.run("/api/ignored")
        room.until("/api/state", lambda now: len(now["cameras"]) == 1)
        assert len(room.get("/api/ignored")) == 1
        name = room.run("POST http://127.0.0.1:8750/api/recording")["name"]
        room.until("/api/modes", lambda now: now["record"]["frames"] >= 10)
        room.run("DELETE http://127.0.0.1:8750/api/recording")
    assert (tmp_path / "kept" / name / "recording.json").exists() and (tmp_path / "room.db").exists()


def test_guard_a_room(tmp_path: Path) -> None:
    """Ended by the signal that services are stopped by; `test_rtsp.py` ends a watch by Ctrl-C's."""
    with served("Guard a room", tmp_path) as room:
        now = room.until("/api/modes", lambda now: now["guard"]["waiting"] >= 2 and now["guard"])
        assert [one["name"] for one in now["rules"]] == ["a camera is here", "a camera is here at night"]
        assert now["rules"][1]["hours"] == ["06:00 to 22:00, every day"]
        room.run("/api/guard/acknowledged")
        assert room.get("/api/modes")["guard"]["waiting"] == 0
        assert room.get("/api/state")["source"] == "demo"
        room.process.terminate()
        assert room.process.wait(30) == 0 and room.process.stdout is not None
        # Nothing more is said, on standard error neither.
        assert room.process.stdout.read() == "Ctrl-C ends it.\n"
    assert (tmp_path / "guard.db").exists()


@pytest.mark.slow
def test_an_exhibit(tmp_path: Path) -> None:
    """With the bundled network on what the bench computes: the hand looks at the marks, as the page has it."""
    with served("An exhibit", tmp_path) as room:
        room.until("/api/state", lambda now: any(one["gaze_x"] for one in now["cameras"]))
        room.run("/api/exhibit/calibration")

        def follow(now: Any) -> Any:
            step = now["exhibit"]["step"]
            if step and step["mark"]:
                room.post("/api/hand", json.dumps({"x": step["mark"][0], "y": step["mark"][1]}))
            return now["exhibit"]["calibrated"] and now["exhibit"]

        made = room.until("/api/modes", follow, 240)
        assert made["error"] < 100 and made["degrees"] < 0.15
        end = time.monotonic() + 60
        while True:
            room.post("/api/hand", json.dumps({"x": 0.7, "y": 0.4}))
            points = room.get("/api/modes")["exhibit"]["pointers"]
            if points and abs(points[0]["x"] - 0.7) < 0.06 and abs(points[0]["y"] - 0.4) < 0.1:
                break
            assert time.monotonic() < end, points
            time.sleep(0.2)
    assert (tmp_path / "kept" / "pointer.json").exists()


@pytest.mark.slow
def test_a_vote(tmp_path: Path) -> None:
    with served("A vote", tmp_path) as room:
        room.until("/api/state", lambda now: sum(one["gaze_x"] is not None for one in now["cameras"]) >= 2)
        room.run("-d")
        room.until("/api/modes", lambda now: sum(now["vote"]["voices"].values()) >= 2, 120)
        room.run("DELETE")
        replay = room.run("/api/vote/replay")
        assert sum(replay[-1]["voices"].values()) >= 2
