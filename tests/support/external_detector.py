"""A detector outside of curate: a script for a bare Python that finds the toy world's objects."""

import shlex
import sys
from pathlib import Path

SCRIPT = '''
"""Find the equally bright clouds of points. Usage: infer.py CLOUDS RESULTS [TEACHER [MODE]]."""

import math, os, signal, struct, sys, time

SIZES = {"Car": (4.0, 1.8, 1.6), "Pedestrian": (0.8, 0.6, 1.7), "Cyclist": (1.8, 0.6, 1.7)}
INTENSITIES = {"Car": 0.9, "Pedestrian": 0.8, "Cyclist": 0.7}
clouds, results = sys.argv[1:3]
teacher = open(sys.argv[3]).read() if len(sys.argv) > 3 and sys.argv[3] else ""
mode = sys.argv[4] if len(sys.argv) > 4 else ""
if mode.startswith("/"):  # a file with the mode of each call, the first line first
    lines = open(mode).read().splitlines()
    open(mode, "w").write("\\n".join(lines[1:]))
    mode = lines[0] if lines else ""
assert "curate" not in sys.modules and "numpy" not in sys.modules
print("mode", mode or "normal", flush=True)
if mode == "exit":
    print("CUDA error:\\n  out of memory", flush=True)
    sys.exit(3)
if mode == "die":
    os.kill(os.getpid(), signal.SIGSEGV)
if mode == "hang":
    time.sleep(600)
if mode == "nothing":
    sys.exit()
rows = []
names = sorted(name for name in os.listdir(clouds) if name.endswith(".bin"))
for name in names[: len(names) // 2] if mode == "half" else names:
    points = list(struct.iter_unpack("<4f", open(os.path.join(clouds, name), "rb").read()))
    for category, intensity in INTENSITIES.items():
        seen = [p for p in points if abs(p[3] - intensity) < 0.01]
        if not seen:
            continue
        x, y, z = (sum(p[i] for p in seen) / len(seen) for i in range(3))
        xx = sum((p[0] - x) ** 2 for p in seen)
        yy = sum((p[1] - y) ** 2 for p in seen)
        xy = sum((p[0] - x) * (p[1] - y) for p in seen)
        score = min(len(seen) / 60, 1.0) * (0.9 if teacher.startswith("student") else 1.0)
        yaw = 0.5 * math.atan2(2 * xy, xx - yy)
        if mode == "percent":
            score *= 100
        if mode == "names":
            category = category.lower()
        rows.append((name[:-4], category, score, x, y, z, *SIZES[category.capitalize()], yaw))
if mode == "others":
    rows.append(("000099", *rows[0][1:]))
if mode == "twice":
    rows *= 2
with open(os.path.join(results, "found.csv"), "w") as file:
    file.write("frame,category,score,x,y,z,length,width,height,yaw\\n")
    for row in rows:
        file.write(",".join(map(str, row)) + "\\n")
'''


def write_script(folder: Path) -> Path:
    """Write the detector into a folder with a space in its name."""
    path = folder / "my detector" / "infer.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text(SCRIPT)
    return path


def command_of(script: Path, *more: str, python: str = sys.executable) -> str:
    """Return the command that runs the script on a batch, without curate's packages."""
    program = shlex.join([python, "-I", "-S", str(script)])
    return " ".join([program, "{clouds}", "{results}", *more])
