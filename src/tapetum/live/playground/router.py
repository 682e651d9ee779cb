"""The requests of the playground, and a small application with it alone."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, Literal

import torch

from tapetum.bench import load_scene, scene_names
from tapetum.errors import InputError
from tapetum.live.app import STATIC, Problem, make_base
from tapetum.live.playground.core import Playground
from tapetum.live.playground.settings import SETTINGS, apply
from tapetum.live.playground.wire import described, limit_json, result_json

from fastapi import APIRouter, FastAPI, HTTPException, Request  # isort: skip
from fastapi.responses import FileResponse  # isort: skip
from pydantic import BaseModel, ConfigDict, Field, ValidationError  # isort: skip

__all__ = ["Asked", "make_play_app", "play_router"]

_LARGEST = 16384
_MOST_WAITING = 16
_REFUSED: dict[int | str, dict[str, Any]] = {
    409: {"model": Problem, "description": "A newer request of the same page came before this one began."},
    413: {"model": Problem},
    422: {"model": Problem},
    503: {"model": Problem},
}


class Asked(BaseModel):
    """A scene by the bundled one it begins from and its changed settings, and what is wanted of it.

    `draft` allows a first picture of a traced lens, on few samples or as of a thin lens. Of two requests of the same
    `page` and `side` that wait, the newer one is computed.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    scene: Annotated[str, Field(max_length=40)] = "thin-lens"
    settings: Annotated[
        dict[Annotated[str, Field(max_length=40)], float | Annotated[str, Field(max_length=40)]],
        Field(max_length=60),
    ] = Field(default_factory=dict)
    part: Literal["picture", "limit"] = "picture"
    draft: bool = False
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    page: Annotated[str, Field(max_length=40)] = ""
    side: Literal["a", "b"] = "a"


def play_router() -> APIRouter:
    """Return the router of `/play` and `/api/play`; pictures are computed one by one in a thread, limits in another."""
    router = APIRouter()
    ground = Playground()
    # One thread of linear algebra: the pictures are small, and a second one waits more than it works. A limit takes up
    # to seconds, which no picture waits for.
    workers = {
        part: ThreadPoolExecutor(1, f"play-{part}", initializer=torch.set_num_threads, initargs=(1,))
        for part in ("picture", "limit")
    }
    newest: dict[tuple[str, str, str], int] = {}
    count = [0, 0]

    async def computed(key: tuple[str, str, str], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        if count[1] >= _MOST_WAITING:
            raise HTTPException(503, "too many scenes wait to be computed; try again in a second")
        count[0] += 1
        number = newest[key] = count[0]

        def run() -> dict[str, Any] | None:
            return work() if newest.get(key) == number else None

        count[1] += 1
        try:
            answer = await asyncio.get_running_loop().run_in_executor(workers[key[2]], run)
        finally:
            count[1] -= 1
            if newest.get(key) == number:
                del newest[key]
        if answer is None:
            raise HTTPException(409, "a newer request of this page came first")
        return answer

    @router.get("/play", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(STATIC / "play.html")

    @router.get("/api/play")
    async def describe() -> dict[str, Any]:
        """Return the settings with their ranges, the scenes to begin with, and the catalogue's lenses."""
        return await asyncio.get_running_loop().run_in_executor(workers["picture"], _described)

    body = {"content": {"application/json": {"schema": _schema()}}, "required": True}

    @router.post("/api/play", responses=_REFUSED, openapi_extra={"requestBody": body})
    async def play(request: Request) -> dict[str, Any]:
        """Compute a scene: its pictures, budget, eye safety and rays, or the limits of one frame."""
        asked = await _read(request)

        def work() -> dict[str, Any]:
            if asked.scene not in scene_names():
                remedy = f"use {', '.join(scene_names())}"
                raise InputError(f"no scene is called {asked.scene!r}", where="scene", remedy=remedy)
            base = load_scene(asked.scene)
            if asked.draft and asked.part == "picture":
                return result_json(*ground.first(base, asked.settings, seed=asked.seed))
            scene = apply(base, asked.settings)
            if asked.part == "limit":
                return limit_json(ground.limit(scene))
            return result_json(scene, ground.result(scene, seed=asked.seed))

        return await computed((asked.page, asked.side, asked.part), work)

    return router


def _schema() -> dict[str, Any]:
    """JSON Schema of a request, with the scenes' names and every setting's range."""
    schema = Asked.model_json_schema()
    values: dict[str, Any] = {
        one.name: {"enum": list(one.choices)}
        if one.choices
        else {"type": "number", "minimum": one.low, "maximum": one.high}
        for one in SETTINGS
    }
    schema["properties"]["scene"]["enum"] = scene_names()
    schema["properties"]["settings"] = {"type": "object", "properties": values, "additionalProperties": False}
    return schema


async def _read(request: Request) -> Asked:
    """The body, never more of it than allowed."""
    content = bytearray()
    async for part in request.stream():
        content += part
        if len(content) > _LARGEST:
            raise HTTPException(413, f"more than {_LARGEST} bytes; a scene's settings take some hundred")
    try:
        return Asked.model_validate_json(bytes(content))
    except ValidationError as error:
        said = [f"{'.'.join(str(part) for part in one['loc']) or 'body'}: {one['msg']}" for one in error.errors()]
        raise HTTPException(422, "; ".join(said)[:500]) from error


@functools.cache
def _described() -> dict[str, Any]:
    return described()


def make_play_app() -> FastAPI:
    """Return an application of this page alone, without doors: for tests, and behind `Doors`."""
    app = make_base("Tapetum bench")
    app.include_router(play_router())

    @app.get("/", include_in_schema=False)
    async def first() -> FileResponse:
        return FileResponse(STATIC / "play.html")

    return app
