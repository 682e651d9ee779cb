"""Read a field between its samples by cubic B-splines.

A sum of cubic B-splines β about equal steps h, with a field's samples as coefficients, passes waves exp(iqj) of q
radians a sample damped by (sin(q/2)/(q/2))⁴, and adds copies of them at q ± 2π that are weaker by (q/(2π - q))⁴. A
field that is the sum of known waves, such as the transform of an aperture, is read exactly but for the copies when each
wave is divided by its damping first.
"""

from __future__ import annotations

import torch

__all__ = ["read_between", "undamped"]

# Places that are read together.
_AT_ONCE = 1 << 15


def undamped(turn: torch.Tensor) -> torch.Tensor:
    """What waves that turn by `turn` radians a sample are multiplied with before `read_between`."""
    return torch.sinc(turn / (2 * torch.pi)) ** -4


def read_between(samples: torch.Tensor, columns: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Sums [B, h, w] of the B-splines of complex `samples` [B, m, n] at places [B, h, w], counted in samples from 0.

    Beyond the first and the last sample all are as those.
    """
    planes = torch.view_as_real(samples).permute(0, 3, 1, 2).contiguous()
    if samples.device.type != "cpu" or any(one.requires_grad for one in (samples, columns, rows)):
        return _read(planes, columns, rows)
    # Some places at a time: all that is computed of them then fits into the processor's caches.
    batch, height, width = columns.shape
    found = samples.new_empty(batch, height, width)
    threads = torch.get_num_threads()
    some, lines = max(1, _AT_ONCE // (height * width)), max(1, _AT_ONCE // width) * threads
    for i in range(0, batch, some):
        for j in range(0, height, lines):
            at = slice(i, i + some), slice(j, j + lines)
            own, x, y = planes[at[0]], columns[at], rows[at]
            if len(own) == 1 and x.shape[1] % threads == 0:
                # Each of a batch is read by one thread: share the lines of one field among them.
                x, y = (one.reshape(threads, -1, width) for one in (x, y))
                own = own.expand(threads, -1, -1, -1)
            found[at] = _read(own, x, y).view_as(found[at])
    return found


def _read(planes: torch.Tensor, columns: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """`read_between`, of real and imaginary planes [B, 2, m, n]."""
    left, right, across = _between(columns, planes.shape[-1])
    upper, lower, down = _between(rows, planes.shape[-2])

    def read(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        # Stacked this way and turned, for a tenth of the time that pairs would take.
        places = torch.stack([x, y]).permute(1, 2, 3, 0)
        return torch.nn.functional.grid_sample(planes, places, "bilinear", "border", align_corners=True)

    above, below = (torch.lerp(read(left, y), read(right, y), across) for y in (upper, lower))
    total = torch.lerp(above, below, down)
    return torch.complex(total[:, 0], total[:, 1])


def _between(at: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where to read linearly, from -1 to 1, before and after each place, and how much [B, 1, h, w] the latter counts.

    Of the four weights that are not zero, each two neighbours are one linear reading between them.
    """
    first, scale = at.floor(), 2 / (count - 1)
    s = at - first
    after = 1 + s * (3 + s * (3 - 2 * s))
    before = 6 - after
    left = first - (1 - s) ** 3 / before
    right = first + s**3 / after
    return left * scale - 1, right * scale + (scale - 1), (after / 6)[:, None]
