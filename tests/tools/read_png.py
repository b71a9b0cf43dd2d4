"""Reads PNG files with Pillow: one path per line of stdin, one line of JSON per path."""

import json
import sys

from PIL import Image

for path in sys.stdin.read().splitlines():
    with Image.open(path) as image:
        image.load()
        flat = image.convert("RGBA").tobytes()
        pixels = [list(flat[at : at + 4]) for at in range(0, len(flat), 4)]
        report = {
            "width": image.size[0],
            "height": image.size[1],
            "mode": image.mode,
            "srgb": "srgb" in image.info,
            "pixels": pixels,
        }
    print(json.dumps(report))
