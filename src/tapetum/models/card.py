"""Schema of a model card, model.json."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from tapetum.checked import Checked, check
from tapetum.errors import InputError
from tapetum.models.architectures import ARCHITECTURES

__all__ = ["check_version", "checked_card"]

_REMEDY = "copy it again or train it again"

Pixels = Annotated[int, Field(ge=1, le=2**20)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Some = Annotated[int, Field(ge=1, lt=2**31)]
Size = Annotated[float, Field(ge=0, le=1e6)]
Strength = Annotated[float, Field(gt=0, le=1e300)]
Share = Annotated[float, Field(ge=0, lt=1)]
Named = Annotated[str, Field(min_length=1)]
Target = str | Annotated[list[str], Field(min_length=1)]


class _Parameters(Checked):
    target: Target
    calibration_fraction: Share


class _Zernike(_Parameters):
    scales: Annotated[list[Pixels], Field(min_length=1)]
    order: Annotated[int, Field(ge=0, le=100)]
    powers: Annotated[list[Annotated[int, Field(ge=1, le=100)]], Field(min_length=1)]
    alpha: Literal["cv"] | Strength
    standardise: bool


class _Network(_Parameters):
    crop: Pixels
    size: Pixels
    epochs: Some
    batch: Some
    learning_rate: Strength
    weight_decay: Size
    gain: Size
    shift: Size
    noise: Size
    seed: Count
    # Cards of version 1 may lack these; `NetworkEstimator.from_state` has their defaults.
    hide: Count = 0
    background: str = "root"
    patience: Some | None = None
    precision: str = "float32"
    interpolate: bool = False


# Named only where it is true: older versions, which would leave out what is interpolated, refuse such a card.
_IF_TRUE = {"interpolate"}


class _Weights(Checked):
    file: Literal["weights.safetensors"]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    bytes: Count
    precision: Literal["half", "full"]


class _Training(Checked):
    units: list[str] | None = None
    chosen: dict[str, Any] | None = None


class _Card(Checked):
    kind: str
    targets: Annotated[list[Named], Field(min_length=1)]
    units: dict[str, str]
    parameters: dict[str, Any]
    training_data: str | None
    metrics: dict[str, Any]
    notes: dict[str, Any] | str | None
    versions: dict[str, str]
    weights: _Weights
    # Cards of version 1 may lack both.
    classes: Annotated[list[Named], Field(default_factory=list)]
    training: _Training | None = None


_PARAMETERS: dict[str, type[_Parameters]] = {"zernike": _Zernike, **dict.fromkeys(ARCHITECTURES, _Network)}


def check_version(version: object, newest: int, where: object) -> None:
    """Refuse a format version that this Tapetum does not read."""
    if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= newest:
        what = f"has version {version!r} of the format, this Tapetum reads up to {newest}"
        raise InputError(what, where=where, remedy="update Tapetum")


def checked_card(card: dict[str, Any], where: object) -> dict[str, Any]:
    """Return a valid card; raise an InputError with the path of the first missing, mistyped or out-of-range key."""
    found = check(_Card, card, where, _REMEDY)
    parameters = check(_PARAMETERS[found.kind], found.parameters, f"{where}: parameters", _REMEDY)
    for part, within in ((found, where), (parameters, f"{where}: parameters")):
        missing = sorted(set(type(part).model_fields) - part.model_fields_set - _IF_TRUE)
        if card["version"] > 1 and missing:
            raise InputError(f"{missing[0]}: is missing", where=within, remedy=_REMEDY)
    unknown = sorted(parameters.model_extra or ())
    if unknown:
        raise InputError(f"parameters.{unknown[0]}: unknown key", where=where, remedy=_REMEDY)
    return card
