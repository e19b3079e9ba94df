"""The plugin in a picture: xvfb-run -a -s "-screen 0 1500x1400x24" python docs/napari_picture.py FILE."""

from __future__ import annotations

import sys
import time

import napari
from PIL import Image
from qtpy.QtWidgets import QApplication


def settle(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()


viewer = napari.Viewer(show=True)
viewer.window.resize(1480, 920)
viewer.open_sample("curvafit", "tubes")
labels = viewer.layers["every 8th slice"]
_, fill = viewer.window.add_plugin_dock_widget("curvafit", "Complete")
fill.annotated.value = labels
fill.run()
while not fill.run_button.enabled:
    settle(0.1)
_, gauge = viewer.window.add_plugin_dock_widget("curvafit", "Measure", tabify=False)
gauge.layer.value = viewer.layers["filled every 8th slice"]
gauge.run()
while not gauge.run_button.enabled:
    settle(0.1)
fill.status.native.setMinimumHeight(280)  # as who drags the edge between the two
viewer.dims.set_current_step(0, 20)
settle(2)
picture = Image.fromarray(viewer.screenshot(canvas_only=False, flash=False)).convert("RGB")
picture.thumbnail((1000, 1000))
picture.save(sys.argv[1], quality=80, method=6)
viewer.close()
