"""The watch's server: its page, its state as JSON, and one socket that pushes states, pictures and events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tapetum.errors import InputError, need
from tapetum.live.doors import Doors
from tapetum.live.events import Ignored
from tapetum.live.loop import Watch

need("fastapi", "live")

from fastapi import APIRouter, FastAPI, HTTPException, Query, Request, Response, WebSocket, WebSocketDisconnect  # noqa: E402
from fastapi.exceptions import RequestValidationError  # noqa: E402
from fastapi.responses import FileResponse, JSONResponse  # noqa: E402
from fastapi.staticfiles import StaticFiles  # noqa: E402
from pydantic import BaseModel, ConfigDict, Field  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["STATIC", "Problem", "Strict", "make_app", "make_base"]

STATIC = Path(__file__).parent / "static"
"""The pages' files."""

_PUSH = 1 / 25  # s between two looks for a new state
_EVENTS = 50
_NUMBER = Annotated[int, Query(ge=0, le=2**62)]


class Strict(BaseModel):
    """Base of requests: no further fields, and no numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class IgnoredPlace(Strict):
    """Every camera within `radius` pixels of a place is ignored."""

    x: float = Field(ge=0, le=1e5)
    y: float = Field(ge=0, le=1e5)
    radius: float = Field(gt=0, le=1e4)


class IgnoredDevice(Strict):
    """Every camera of a device is ignored."""

    device: str = Field(min_length=1, max_length=200)


class IgnoredLook(Strict):
    """A camera that is here now is ignored wherever it looks as it did in the last minute."""

    camera: str = Field(min_length=1, max_length=64)


class IgnoredOne(BaseModel):
    """A camera of ours: its name in this list, what it is known by, and where, as what device or by how many looks."""

    id: str
    by: Literal["place", "device", "look"]
    x: float
    y: float
    radius: float
    device: str
    looks: int


class Problem(Strict):
    """Why a request was refused, in one line."""

    detail: str


_JPEG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}}, 404: {"model": Problem}}


def make_base(title: str) -> FastAPI:
    """Return an application that answers bad input with one clear line, and serves the pages' files."""
    app = FastAPI(title=title, docs_url=None, redoc_url=None, responses={422: {"model": Problem}})

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        said = [f"{'.'.join(str(part) for part in one['loc'][1:]) or 'body'}: {one['msg']}" for one in error.errors()]
        return JSONResponse({"detail": "; ".join(said)}, status_code=422)

    @app.exception_handler(InputError)
    async def _refused(request: Request, error: InputError) -> JSONResponse:
        return JSONResponse({"detail": str(error)}, status_code=422)

    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    return app


def make_app(
    watch: Watch,
    hosts: tuple[str, ...] = ("127.0.0.1", "localhost", "::1"),
    token: str | None = None,
    routers: Iterable[APIRouter] = (),
    *,
    pushed: Callable[[], str] | None = None,
    largest: dict[str, int] | None = None,
) -> Doors:
    """Return the server of a watch as an ASGI application; the watch is started and closed with it.

    Parameters
    ----------
    watch
        Not yet started.
    hosts, token
        As for `Doors`.
    routers
        Further requests that are answered, as those of the modes.
    pushed
        Gives a further message for the socket, which sends it when it has changed.
    largest
        As for `Doors`.
    """

    app = make_base("Tapetum watch")

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(watch.close)

    app.router.lifespan_context = life

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(STATIC / "index.html")

    @app.get("/api/state")
    async def state() -> dict[str, Any]:
        """Return the state after the latest frame."""
        return watch.state.as_json()

    @app.get("/api/events")
    async def events(after: _NUMBER = 0, most: Annotated[int, Query(ge=1, le=1000)] = _EVENTS) -> list[dict[str, Any]]:
        """Return the latest events with a number above `after`, oldest first."""
        return await asyncio.to_thread(watch.log.events, after, most)

    @app.get("/api/events/{number}/picture", responses=_JPEG, response_class=Response)
    async def evidence(number: int) -> Response:
        """Return the picture of an event."""
        found = await asyncio.to_thread(watch.log.picture, number) if 0 < number < 2**62 else None
        if found is None:
            raise HTTPException(404, f"event {number} has no picture, or no more")
        return Response(found, media_type="image/jpeg")

    @app.get("/api/frame.jpg", responses=_JPEG, response_class=Response)
    async def frame() -> Response:
        """Return the latest frame that is shown."""
        _, picture = await asyncio.to_thread(watch.picture)
        if not picture:
            raise HTTPException(404, "no frame has arrived yet")
        return Response(picture, media_type="image/jpeg")

    @app.get("/api/ignored")
    async def ignored() -> list[IgnoredOne]:
        """Return the cameras that are ignored."""
        return [_told(one) for one in watch.events.ignored]

    @app.post("/api/ignored", status_code=204, responses={409: {"model": Problem}})
    async def ignore(one: IgnoredPlace | IgnoredDevice | IgnoredLook) -> None:
        """Ignore a camera from now on: by its place, its device, or its look."""
        if isinstance(one, IgnoredLook):
            try:
                await asyncio.to_thread(watch.ignore_look, one.camera)
            except InputError as error:
                raise HTTPException(409, str(error)) from error
            return
        await asyncio.to_thread(watch.ignore, Ignored(**one.model_dump()))

    @app.delete("/api/ignored", status_code=204, responses={404: {"model": Problem}})
    async def forget(one: Annotated[str, Query(max_length=64)] = "") -> None:
        """Report on a camera of ours again, by its `id` of the list; without one, on every camera."""
        found = next((each for each in watch.events.ignored if each.id == one), None)
        if one and found is None:
            raise HTTPException(404, "that camera is not in the list of ours")
        await asyncio.to_thread(watch.forget_ignored, found)

    @app.websocket("/ws")
    async def push(socket: WebSocket, after: _NUMBER = 0, pictures: bool = True) -> None:
        """Push states, pictures of frames and events; a slow client gets fewer states, and every event."""
        await socket.accept()
        sender = asyncio.create_task(_push(socket, watch, after, pictures, pushed))
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                # Messages of a client are ignored; only its disconnection matters.
                await socket.receive_text()
        sender.cancel()
        with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError, OSError):
            await sender

    for router in routers:
        app.include_router(router)
    return Doors(app, hosts, token, largest=largest)


def _told(one: Ignored) -> IgnoredOne:
    by: Literal["place", "device", "look"] = "look" if one.looks else "device" if one.device else "place"
    return IgnoredOne(id=one.id, by=by, x=one.x, y=one.y, radius=one.radius, device=one.device, looks=len(one.looks))


async def _push(socket: WebSocket, watch: Watch, after: int, pictures: bool, pushed: Callable[[], str] | None) -> None:
    """Send the newest of everything, until the client goes; each message waits until the one before is taken."""
    told: Any = None
    shown = -1
    last = after
    said = ""
    while True:
        state = watch.state
        if state is not told:
            told = state
            await socket.send_json({"type": "state", **state.as_json()})
            if watch.log.newest > last:
                for event in await asyncio.to_thread(watch.log.events, last, _EVENTS):
                    last = event["number"]
                    await socket.send_json({"type": "event", "event": event})
        if pushed is not None and (text := await asyncio.to_thread(pushed)) != said:
            said = text
            await socket.send_text(text)
        if pictures:
            number, picture = await asyncio.to_thread(watch.picture)
            if number > shown:
                shown = number
                await socket.send_bytes(number.to_bytes(8, "big") + picture)
        await asyncio.sleep(_PUSH)
