#!/usr/bin/env bash
# a Meshcat recording at its own frame rate puts some pictures into the frame before, over the one that is there
#
# Versions: drake 1.58.0 (pip), CPython 3.12 or newer, Linux x86-64.
#
# Expected: MeshcatVisualizer publishes with a period of 1/25 s and records with 25 frames a second (StartRecording takes
# the rate from the period), so picture k is in frame k.
#
# Seen: MeshcatAnimation.frame() multiplies the time by the rate and cuts off what is behind the point. At the times of a
# Simulator's periodic publish events, k * 0.04, the product is a hair below k for some k: these pictures land in frame
# k - 1 and take the place of the one before, and frame k stays empty. The page draws what lies between its neighbours. With
# 64 frames a second, the default, and other powers of two nothing is lost.
#
# Why it matters: a body that turns fast is drawn where it was not, by up to a frame's way, at some instants only. Who
# checks a page against the simulation looks for the fault elsewhere. Way around: publish a hair later than k / 25
# where the times are one's own, or record with a power of two.
#
# Run: bash findings/drake-meshcat-recording-loses-frames.sh   (a virtual environment in a temporary folder; two minutes)
set -euo pipefail
PYTHON="${PYTHON:-python3.12}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
"$PYTHON" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check "drake==1.58.*"

cat > "$work/frames.py" <<'PROGRAM'
from pydrake.geometry import MeshcatAnimation
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

N = 1000


class Camera(LeafSystem):
    def __init__(self, rate):
        super().__init__()
        self.times = []
        self.DeclarePeriodicPublishEvent(1.0 / rate, 0.0, lambda context: self.times.append(context.get_time()))


for rate in (25.0, 30.0, 50.0, 60.0, 100.0, 32.0, 64.0, 128.0):
    camera = Camera(rate)
    simulator = Simulator(camera)
    simulator.Initialize()
    simulator.AdvanceTo((N + 0.5) / rate)
    recording = MeshcatAnimation(rate)
    frames = [recording.frame(time) for time in camera.times[:N]]
    assert len(frames) == N
    early = [k for k, frame in enumerate(frames) if frame == k - 1]
    assert all(frame in (k - 1, k) for k, frame in enumerate(frames))
    print(f"{rate:3.0f} frames a second: {len(early):2d} of {N} pictures in the frame before, first {early[:3]}")
PROGRAM

cat > "$work/expected" <<'SEEN'
 25 frames a second: 21 of 1000 pictures in the frame before, first [29, 58, 116]
 30 frames a second: 50 of 1000 pictures in the frame before, first [31, 62, 111]
 50 frames a second: 21 of 1000 pictures in the frame before, first [29, 58, 116]
 60 frames a second: 50 of 1000 pictures in the frame before, first [31, 62, 111]
100 frames a second: 21 of 1000 pictures in the frame before, first [29, 58, 116]
 32 frames a second:  0 of 1000 pictures in the frame before, first []
 64 frames a second:  0 of 1000 pictures in the frame before, first []
128 frames a second:  0 of 1000 pictures in the frame before, first []
SEEN
"$work/venv/bin/python" "$work/frames.py" | tee "$work/seen"
diff "$work/expected" "$work/seen" && echo "as seen before"
