"""The requests of the modes."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated, Any, Literal

from tapetum.errors import InputError
from tapetum.live.app import Problem, Strict
from tapetum.live.events import Region
from tapetum.live.modes.board import Modes, ModesState
from tapetum.live.pointer import Screen
from tapetum.live.vote import Ballot, Tally
from tapetum.record.hand import Aim

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response  # isort: skip
from pydantic import BaseModel, BeforeValidator, Field  # isort: skip

__all__ = ["LARGEST", "modes_router"]

UPLOAD = 32 << 20
LARGEST = {"/api/scan": UPLOAD}
"""Bytes of a request's body by path, at most, as `Doors` takes them."""
_UPLOADS_AT_ONCE = 2

_CONFLICT: dict[int | str, dict[str, Any]] = {
    409: {"model": Problem, "description": "Not as things stand; the reason says what is missing."}
}
_FULL: dict[int | str, dict[str, Any]] = {413: {"model": Problem}, 429: {"model": Problem}}
_JPEG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}}, 404: {"model": Problem}}

# JSON has no type for whole numbers: 3.0 is one.
_Whole = BeforeValidator(lambda value: int(value) if isinstance(value, float) and value.is_integer() else value)
Share = Annotated[float, Field(ge=-0.5, le=1.5)]
Side = Annotated[float, Field(ge=-10, le=10)]


class Calibrating(Strict):
    """A calibration that begins: its marks, the camera ("": the first that shows its gaze), and the screen.

    `width` and `height` are in pixels; `across`, the screen's width, and `distance`, the camera's from it, in metres,
    are only wanted for errors as angles.
    """

    marks: Annotated[Literal[1, 4, 9], _Whole] = 9
    camera: str = Field("", max_length=64)
    width: Annotated[int, _Whole] = Field(gt=0, le=100_000)
    height: Annotated[int, _Whole] = Field(gt=0, le=100_000)
    across: float | None = Field(None, gt=0, le=1000)
    distance: float | None = Field(None, gt=0, le=1000)


class Zone(Strict):
    """An answer of a vote, as a part of the plane."""

    name: str = Field(min_length=1, max_length=80)
    left: Side
    top: Side
    right: Side
    bottom: Side


class Asking(Strict):
    """A vote that begins (see `tapetum.live.vote.Ballot`)."""

    question: str = Field(max_length=300)
    zones: list[Zone] = Field(min_length=2, max_length=12)
    plane: Literal["field", "screen"] = "field"
    dwell: float = Field(1.0, ge=0, le=60)
    keep: bool = False


class Acknowledging(Strict):
    """The number of an alert's event; without it, all alerts."""

    number: Annotated[int | None, _Whole] = Field(None, ge=1, le=2**62)


class Pointed(Strict):
    """Where a simulated hand points, in fractions of the screen."""

    x: Share
    y: Share
    hand: Annotated[int, _Whole] = Field(0, ge=0, le=2)


class Begun(BaseModel):
    """The number of a search."""

    id: int


class Named(BaseModel):
    """The name of a recording in the page's folder."""

    name: str


def modes_router(modes: Modes, aim: Aim | None = None) -> APIRouter:
    """Return the router of a page's modes; `aim` leads simulated hands."""
    router = APIRouter()
    reading = 0

    @router.get("/api/modes")
    async def now() -> ModesState:
        """Return how all modes stand; the socket pushes the same as `{"type": "modes", ...}`."""
        return await asyncio.to_thread(modes.now)

    @router.post("/api/exhibit/calibration", status_code=204, responses=_CONFLICT)
    async def calibrate(asked: Calibrating) -> None:
        """Begin a calibration; what to do next stands in the exhibit's `step`."""
        screen = Screen(asked.width, asked.height, asked.across, asked.distance)
        try:
            modes.exhibit.begin(screen, asked.marks, asked.camera)
        except InputError as error:
            raise HTTPException(409, str(error)) from error

    @router.delete("/api/exhibit/calibration", status_code=204)
    async def cancel(forget: bool = False) -> None:
        """End a calibration under way; with `forget` drop the one that was made, too."""
        await asyncio.to_thread(modes.exhibit.forget if forget else modes.exhibit.cancel)

    @router.post("/api/vote", status_code=204, responses=_CONFLICT)
    async def ask(asked: Asking) -> None:
        """Begin a vote; the one before ends."""
        try:
            zones = tuple(Region(one.name, one.left, one.top, one.right, one.bottom) for one in asked.zones)
            ballot = Ballot(asked.question, zones, asked.plane, asked.dwell, asked.keep)
        except InputError as error:
            raise HTTPException(409, str(error)) from error
        if asked.plane == "screen" and modes.exhibit.calibration is None:
            raise HTTPException(409, "zones of a screen need a calibration: make one under Exhibit")
        await asyncio.to_thread(modes.poll.begin, ballot, modes.exhibit.calibration)

    @router.delete("/api/vote", status_code=204)
    async def end() -> None:
        """Take no more voices; the tally stays."""
        await asyncio.to_thread(modes.poll.end)

    @router.get("/api/vote/replay")
    async def replay() -> list[Tally]:
        """Return the tally after each voice of the latest vote, the oldest first."""
        return await asyncio.to_thread(modes.poll.replayed)

    @router.post("/api/guard/acknowledged", status_code=204, responses={404: {"model": Problem}})
    async def acknowledge(asked: Acknowledging) -> None:
        """Acknowledge an alert, or all."""
        try:
            await asyncio.to_thread(modes.desk.acknowledge, asked.number, time.time_ns())
        except InputError as error:
            raise HTTPException(404, str(error)) from error

    raw = {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}

    @router.post(
        "/api/scan", status_code=202, responses=_FULL, openapi_extra={"requestBody": {**raw, "required": True}}
    )
    async def upload(
        request: Request,
        kind: Literal["single", "pair", "film"],
        first: Annotated[int, Query(ge=0, le=UPLOAD)] = 0,
    ) -> Begun:
        """Look for cameras in an uploaded picture, in a lit and a dark one, or in a short film.

        The body holds the file, of a pair the lit picture and then the dark one, `first` being the length of the former
        in bytes. JPEG, PNG, WebP; MP4, MOV, WebM, Matroska, AVI. The result stands in the scan's `searches`.
        """
        nonlocal reading
        if modes.scan.full or reading >= _UPLOADS_AT_ONCE:
            raise HTTPException(429, "too many uploads wait; try again in some seconds")
        reading += 1
        try:
            content = bytearray()
            async for part in request.stream():
                content += part
                if len(content) > UPLOAD:
                    raise HTTPException(413, f"larger than {UPLOAD >> 20} MB")
        finally:
            reading -= 1
        return Begun(id=modes.scan.begin(bytes(content), kind, first))

    @router.get("/api/scan/{number}/picture", responses=_JPEG, response_class=Response)
    async def picture(
        number: Annotated[int, Path(ge=0, le=2**62)],
        candidate: Annotated[int, Query(ge=0, le=1000)] = 0,
        which: Literal["lit", "dark"] = "lit",
    ) -> Response:
        """Return the picture of a search, or the surroundings of one of its candidates."""
        found = modes.scan.picture(number, candidate, which)
        if found is None:
            raise HTTPException(404, f"search {number} has no such picture, or no more")
        return Response(found, media_type="image/jpeg")

    @router.post("/api/scan/coverage", status_code=204)
    async def start() -> None:
        """Begin the map of a live scan again."""
        await asyncio.to_thread(modes.scan.start)

    @router.delete("/api/scan/coverage", status_code=204)
    async def stop() -> None:
        """End the live scan; its map stays."""
        await asyncio.to_thread(modes.scan.stop)

    @router.post("/api/recording", status_code=201, responses=_CONFLICT)
    async def record() -> Named:
        """Begin a recording of the source in the page's folder; its name is the server's."""
        try:
            return Named(name=await asyncio.to_thread(modes.recorder.start))
        except InputError as error:
            raise HTTPException(409, str(error)) from error

    @router.delete("/api/recording", status_code=204)
    async def finish() -> None:
        """End the recording."""
        await asyncio.to_thread(modes.recorder.stop)

    if aim is not None:

        @router.post("/api/hand", status_code=204)
        async def lead(asked: Pointed) -> None:
            """Lead a simulated hand to a place of the screen."""
            aim.point(asked.x, asked.y, asked.hand)

    return router
