"""An environment for `chess_set.usda`: arches in old walls, and trees in the sun behind them.

python arcade.py arcade.exr
"""

import sys

import numpy as np
import OpenEXR

WIDTH, HEIGHT = 1024, 512
# Left and right edge and height at which an arch begins, in degrees, and what is in it. The later one is in front.
ARCHES = [
    (31, 39, 9, "trees"),
    (46, 66, 22, "plaster"),
    (57, 63, 18, "trees"),
    (73, 100, 14, "plaster"),
    (78, 97, 9, "trees"),
    (110, 150, 18, "plaster"),
    (116, 150, 14, "trees"),
    (180, 206, 16, "trees"),
    (265, 300, 12, "trees"),
    (335, 355, 14, "plaster"),
    (341, 355, 11, "trees"),
]
SILL, EDGE = -10.0, 0.5
WALL, FLOOR, VAULT = [0.085, 0.052, 0.032], [0.04, 0.03, 0.022], [0.035, 0.022, 0.014]
PLASTER, LEAVES, SUNLIT_LEAVES, SKY = [0.95, 0.8, 0.66], [0.17, 0.19, 0.07], [1.2, 1.18, 0.5], [2.5, 2.28, 1.95]


def noise(azimuth, elevation, cells, random):
    """Smooth noise from 0 to 1, of so many cells around."""
    values = random.random((cells // 2 + 2, cells))
    x, y = azimuth / 360 * cells, (90 - elevation) / 360 * cells
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = ((each - np.floor(each)) for each in (x, y))
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    at = [[values[row + i, (column + j) % cells] for j in (0, 1)] for i in (0, 1)]
    rows = [each[0] * (1 - s) + each[1] * s for each in at]
    return rows[0] * (1 - t) + rows[1] * t


def mixed(first, second, amount):
    """Of two colours or images, so much of the second."""
    return np.asarray(first) + (np.asarray(second) - first) * np.clip(amount, 0, 1)[..., None]


def environment():
    """Radiance ``(height, width, 3)``: azimuths from -z over +x, elevations from above."""
    random = np.random.default_rng(7)
    azimuth = np.broadcast_to((np.arange(WIDTH) + 0.5) * 360 / WIDTH, (HEIGHT, WIDTH))
    elevation = np.broadcast_to(90 - (np.arange(HEIGHT)[:, None] + 0.5) * 180 / HEIGHT, (HEIGHT, WIDTH))

    def octaves(first):
        return sum(noise(azimuth, elevation, first * 2**i, random) / 2 ** (i + 1) for i in range(4))

    leaves = octaves(96)
    trees = mixed(mixed(LEAVES, SUNLIT_LEAVES, 4 * (leaves - 0.36)), SKY, 6 * (leaves - 0.58) + elevation / 80)
    surfaces = {"trees": trees, "plaster": mixed(PLASTER, 0.5 * np.array(PLASTER), 2 * octaves(48) - 0.7)}
    stained = mixed(0.4 * np.array(WALL), 1.8 * np.array(WALL), 2.4 * octaves(32) - 0.7)
    found = mixed(stained, VAULT, (elevation - 40) / 20)
    for left, right, spring, surface in ARCHES:
        half = (right - left) / 2
        across = (azimuth - (left + right) / 2 + 180) % 360 - 180
        inside = half - np.hypot(across, np.maximum(elevation - spring, 0))
        found = mixed(found, surfaces[surface], np.minimum(inside, elevation - SILL) / EDGE + 0.5)
    return mixed(found, FLOOR, (SILL - elevation) / 2)


if __name__ == "__main__":
    header = {"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}
    image = environment().astype(np.float16)
    with OpenEXR.File(header, {"RGB": image}) as file:
        file.write(sys.argv[1])
