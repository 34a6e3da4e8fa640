"""A made-up street: the path a car takes, and the boxes that stand beside it. Host side, numpy, float64."""

import dataclasses

import numpy as np

# One block of the path: a straight, a bend and a straight, in frames. Blocks bend left and right in turn.
BLOCK = 48
_BEND_START, _BEND_RAMP, _BEND_FRAMES = 13, 5, 25
_EXTENSION = 60
# A lap: four longer blocks that bend by a right angle each, to the same side. Turned copies of one block close exactly.
LAP = 500
_LAP_BEND_START = 60
GROUND_Y = 1.65
GRID_STEP = 0.5
_OFF_LANE = 30.0


@dataclasses.dataclass(frozen=True)
class Path:
    """Where the camera goes, one entry per base frame (10 Hz) in the street frame: x right, y down, z forward.

    Attributes:
        x: Position, metres.
        z: Position, metres.
        heading: Angle from +z towards +x, radians.
        distance: Arc length, metres.
        closed: True for a lap that ends where it begins; frames and arc lengths then go round and round.
    """

    x: np.ndarray
    z: np.ndarray
    heading: np.ndarray
    distance: np.ndarray
    closed: bool = False

    def at(self, distance: np.ndarray, lateral: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position and heading at an arc length, `lateral` metres to the right."""
        if self.closed:
            distance = np.mod(distance, self.distance[-1])
        heading = np.interp(distance, self.distance, self.heading)
        x = np.interp(distance, self.distance, self.x) + lateral * np.cos(heading)
        z = np.interp(distance, self.distance, self.z) - lateral * np.sin(heading)
        return x, z, heading

    def place(self, distance: float, lateral: float = 0.0) -> tuple[float, float, float]:
        """The same for one arc length."""
        x, z, heading = self.at(np.array([distance]), lateral)
        return float(x[0]), float(z[0]), float(heading[0])

    def at_frame(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position and heading at a frame, or between two."""
        frame = np.mod(frame, LAP) if self.closed else frame
        count = np.arange(len(self.x))
        x, z, heading = (np.interp(frame, count, values) for values in (self.x, self.z, self.heading))
        return x, z, heading


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Upright boxes in the street frame, one row each.

    Attributes:
        geometry: x and z of the centre, yaw, half sizes along box x and z, y of the top and of the bottom.
        materials: Columns as `vojax.datasets._texture.Material`.
    """

    geometry: np.ndarray
    materials: np.ndarray


def make_path(frames: int, seed: int) -> Path:
    """Lay a path of at least `frames` base frames, and some straight street after it.

    The first frames do not depend on how many are asked for.
    """
    blocks = -(-frames // BLOCK)
    count = blocks * BLOCK
    rng = np.random.default_rng([seed, 1])
    first_sign = rng.choice([-1.0, 1.0])
    phase = rng.uniform(0, 2 * np.pi)
    rate = np.zeros(count)
    for block in range(blocks):
        angle = np.deg2rad(rng.uniform(68, 86)) * first_sign * (-1.0) ** block
        start = block * BLOCK + _BEND_START
        rate[start : start + _BEND_FRAMES] = _bend(angle)
    speed = 0.90 + 0.05 * np.sin(2 * np.pi * np.arange(count) / 31 + phase) - 0.08 * np.abs(rate) / 0.065
    rate = np.concatenate([rate, np.zeros(_EXTENSION)])
    speed = np.concatenate([speed, np.ones(_EXTENSION)])
    return Path(*_integrate(rate, speed))


def make_lap(seed: int) -> Path:
    """A lap of `LAP` frames: four straights and four bends of 90 degrees, up to 5 degrees a frame."""
    rng = np.random.default_rng([seed, 1])
    sign = rng.choice([-1.0, 1.0])
    block = LAP // 4
    rate = np.zeros(block)
    rate[_LAP_BEND_START : _LAP_BEND_START + _BEND_FRAMES] = sign * _bend(np.pi / 2)
    speed = 0.90 + 0.05 * np.sin(2 * np.pi * np.arange(block) / 31) - 0.08 * np.abs(rate) / 0.065
    rate, speed = np.tile(rate, 4), np.tile(speed, 4)
    return Path(*_integrate(rate, speed), closed=True)


def _bend(angle: float) -> np.ndarray:
    """Change of heading per frame in a bend, with smooth ends."""
    k = np.arange(_BEND_FRAMES) + 0.5
    ramp = np.clip(np.minimum(k, _BEND_FRAMES - k) / _BEND_RAMP, 0, 1)
    ramp = ramp * ramp * (3 - 2 * ramp)
    return angle * ramp / ramp.sum()


def _integrate(rate: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, z, heading and arc length from changes of heading and lengths of steps."""
    heading = np.concatenate([[0.0], np.cumsum(rate)])
    middle = heading[:-1] + rate / 2
    x = np.concatenate([[0.0], np.cumsum(speed * np.sin(middle))])
    z = np.concatenate([[0.0], np.cumsum(speed * np.cos(middle))])
    return x, z, heading, np.concatenate([[0.0], np.cumsum(speed)])


def street_from_camera(path: Path, frame: np.ndarray, seed: int) -> np.ndarray:
    """Camera poses `[n, 4, 4]` on the path with gentle sway, heave, roll, pitch and yaw."""
    rng = np.random.default_rng([seed, 2])
    phase = rng.uniform(0, 2 * np.pi, 5)
    period = np.array([23.0, 11.0, 17.0, 13.0, 19.0])
    wave = np.sin(2 * np.pi * frame[:, None] / period + phase)
    sway, heave = 0.08 * wave[:, 0], 0.03 * wave[:, 1]
    roll, pitch, yaw = (np.deg2rad(a) * wave[:, j] for a, j in ((1.0, 2), (0.7, 3), (0.7, 4)))
    x, z, heading = path.at_frame(frame)
    pose = np.zeros((len(frame), 4, 4))
    pose[:, :3, :3] = _rot(heading + yaw, 1) @ _rot(pitch, 0) @ _rot(roll, 2)
    pose[:, 0, 3] = x + sway * np.cos(heading)
    pose[:, 1, 3] = heave
    pose[:, 2, 3] = z - sway * np.sin(heading)
    pose[:, 3, 3] = 1
    return pose


def _rot(angle: np.ndarray, axis: int) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.zeros((len(angle), 3, 3))
    matrix[:, axis, axis] = 1
    matrix[:, i, i], matrix[:, j, j], matrix[:, i, j], matrix[:, j, i] = c, c, -s, s
    return matrix


class _Builder:
    """Collects boxes; refuses those that would stand in the way."""

    def __init__(self, path: Path, seed: int):
        self.path = path
        self.rng = np.random.default_rng([seed, 3])
        keep = np.arange(0.0, path.distance[-1], 0.5)
        self.lane_x, self.lane_z, _ = path.at(keep)
        # The middle of the oncoming lane is kept clear too.
        self.other_x, self.other_z, _ = path.at(keep, -3.5)
        self.geometry: list[tuple[float, ...]] = []
        self.materials: list[tuple[float, ...]] = []

    def clear(self, x: float, z: float, yaw: float, half_x: float, half_z: float, margin: float) -> bool:
        """Whether both lanes stay `margin` metres away from the box."""
        for lane_x, lane_z in ((self.lane_x, self.lane_z), (self.other_x, self.other_z)):
            c, s = np.cos(yaw), np.sin(yaw)
            bx = c * (lane_x - x) - s * (lane_z - z)
            bz = s * (lane_x - x) + c * (lane_z - z)
            away = np.hypot(np.maximum(np.abs(bx) - half_x, 0), np.maximum(np.abs(bz) - half_z, 0))
            if away.min() < margin:
                return False
        return True

    def add(self, geometry: tuple[float, ...], material: tuple[float, ...]) -> None:
        self.geometry.append(geometry)
        albedo, *rest = material
        self.materials.append((albedo, float(len(self.materials) + 1), *rest))


def make_boxes(path: Path, seed: int) -> Boxes:
    """Line the street with houses, parked cars, lamp posts and street furniture."""
    builder = _Builder(path, seed)
    end = path.distance[-1]
    for side, offset in ((1.0, 6.4), (-1.0, 9.9)):
        _houses(builder, side, offset, end)
    _backdrop(builder, end)
    for side, lateral in ((1.0, 3.15), (-1.0, 6.65)):
        _cars(builder, side, lateral, end)
        _furniture(builder, side, lateral + 1.35, end)
    return Boxes(np.array(builder.geometry), np.array(builder.materials))


def house_material(rng: np.random.Generator) -> tuple[float, ...]:
    """Albedo, course size, window grid: brick, stone or plaster."""
    albedo = rng.choice([0.20, 0.28, 0.40, 0.55, 0.70]) + rng.uniform(-0.03, 0.03)
    course = [(0.30, 0.10), (0.80, 0.40), (1.20, 0.60)][rng.integers(3)]
    return (albedo, *course, rng.uniform(2.0, 3.0), rng.uniform(2.9, 3.4), rng.uniform(1.0, 1.4), rng.uniform(1.4, 1.9))


def _houses(builder: _Builder, side: float, offset: float, end: float) -> None:
    rng = builder.rng
    s = -6.0
    while s < end + 4:
        half_length, half_depth = rng.uniform(3.5, 6.5), rng.uniform(4.0, 5.0)
        setback = offset + rng.choice([0.0, 0.0, 0.4, 0.9])
        height = rng.choice([6.6, 7.5, 9.6, 10.5, 12.8])
        material = house_material(rng)
        for push in (0.0, 0.7, 1.5, 3.0, 5.0):
            x, z, heading = builder.path.place(s + half_length, side * (setback + push + half_depth))
            if s < 0:
                x, z = side * (setback + half_depth), s + half_length
            # Box x runs along the street.
            yaw = heading - np.pi / 2
            if builder.clear(x, z, yaw, half_length, half_depth, 4.2 if side > 0 else 5.4):
                builder.add((x, z, yaw, half_length, half_depth, GROUND_Y - height, GROUND_Y), material)
                break
        s += 2 * half_length + rng.choice([0.0, 0.0, 0.3, 2.2])


def _backdrop(builder: _Builder, end: float) -> None:
    """A second row behind the houses, and one block across the far end of the street."""
    rng = builder.rng
    for side in (1.0, -1.0):
        for s in np.arange(0.0, end, 15.0):
            x, z, heading = builder.path.place(s + rng.uniform(-3, 3), side * rng.uniform(24, 34))
            half, height = rng.uniform(5, 8), rng.uniform(13, 19)
            yaw = heading - np.pi / 2 + rng.uniform(-0.3, 0.3)
            if builder.clear(x, z, yaw, half, half, 12.0):
                builder.add((x, z, yaw, half, half, GROUND_Y - height, GROUND_Y), house_material(rng))
    if builder.path.closed:
        return
    x, z, heading = builder.path.place(end)
    x, z = x + 9 * np.sin(heading), z + 9 * np.cos(heading)
    builder.add((x, z, heading, 17.0, 5.0, GROUND_Y - 11.5, GROUND_Y), house_material(rng))


def car_boxes(x: float, z: float, heading: float, rng: np.random.Generator) -> list[tuple]:
    """Body and cabin of a car as (geometry, material) pairs."""
    albedo = rng.choice([0.10, 0.20, 0.36, 0.60, 0.75])
    half, width = rng.uniform(1.9, 2.2), rng.uniform(0.82, 0.9)
    yaw = heading - np.pi / 2
    back = rng.uniform(-0.4, 0.1)
    cx, cz = x + back * np.sin(heading), z + back * np.cos(heading)
    body = (x, z, yaw, half, width, GROUND_Y - 0.85, GROUND_Y - 0.22)
    cabin = (cx, cz, yaw, 0.56 * half, width - 0.12, GROUND_Y - 1.42, GROUND_Y - 0.85)
    return [
        (body, (albedo, 1.15, 3.0, 9.0, 9.0, -1.0, 0.0)),
        (cabin, (albedo, 9.0, 9.0, 1.1, 0.48, 1.0, 0.34)),
    ]


def _cars(builder: _Builder, side: float, lateral: float, end: float) -> None:
    rng = builder.rng
    s = rng.uniform(4, 12)
    while s < end:
        x, z, heading = builder.path.place(s, side * lateral)
        if builder.clear(x, z, heading - np.pi / 2, 2.2, 0.9, 1.5):
            for geometry, material in car_boxes(x, z, heading, rng):
                builder.add(geometry, material)
        s += rng.choice([6.0, 12.0, 19.0]) + rng.uniform(0, 2)


def _furniture(builder: _Builder, side: float, lateral: float, end: float) -> None:
    """Lamp posts, and crates or kiosks on the pavement."""
    rng = builder.rng
    for s in np.arange(rng.uniform(3, 9), end, 14.0):
        x, z, heading = builder.path.place(s, side * lateral)
        if builder.clear(x, z, 0.0, 0.1, 0.1, 2.0):
            builder.add((x, z, heading, 0.08, 0.08, GROUND_Y - 5.2, GROUND_Y), (0.2, 0.5, 0.9, 9.0, 9.0, 0.0, 0.0))
        x, z, heading = builder.path.place(s + rng.uniform(4, 9), side * (lateral + rng.uniform(0.5, 1.0)))
        half, height = rng.uniform(0.25, 0.55), rng.uniform(0.7, 1.9)
        if builder.clear(x, z, 0.0, 0.7, 0.7, 2.0):
            material = (rng.uniform(0.25, 0.65), 0.9, rng.uniform(0.15, 0.3), 9.0, 9.0, 0.0, 0.0)
            yaw = heading + rng.uniform(-0.4, 0.4)
            builder.add((x, z, yaw, half, half, GROUND_Y - height, GROUND_Y), material)


def lane_grid(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Signed lateral and longitudinal lane coordinate `[2, rows, columns]` on a grid, and the x and z of its corner."""
    distance = np.arange(-20.0, path.distance[-1] + 20.0, 0.25)
    inside = np.clip(distance, 0, path.distance[-1])
    x, z, heading = path.at(inside)
    x, z = x + (distance - inside) * np.sin(heading), z + (distance - inside) * np.cos(heading)
    reach = int(14 / GRID_STEP)
    corner = np.array([x.min(), z.min()]) - (reach + 1) * GRID_STEP
    shape = tuple(
        int(np.ceil((values.max() - low) / GRID_STEP)) + reach + 2 for values, low in ((z, corner[1]), (x, corner[0]))
    )
    nearest = np.full(shape, np.inf)
    lateral, along = np.full(shape, _OFF_LANE), np.zeros(shape)
    window = np.arange(-reach, reach + 1)
    for xi, zi, hi, si in zip(x, z, heading, distance, strict=True):
        column, row = round((xi - corner[0]) / GRID_STEP), round((zi - corner[1]) / GRID_STEP)
        part = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
        gx = (corner[0] + (column + window) * GRID_STEP - xi)[None, :]
        gz = (corner[1] + (row + window) * GRID_STEP - zi)[:, None]
        closer = gx * gx + gz * gz < nearest[part]
        nearest[part] = np.where(closer, gx * gx + gz * gz, nearest[part])
        lateral[part] = np.where(closer, gx * np.cos(hi) - gz * np.sin(hi), lateral[part])
        along[part] = np.where(closer, si + gx * np.sin(hi) + gz * np.cos(hi), along[part])
    return np.stack([lateral, along]), corner
