"""The napari plugin: complete a labels layer between annotated slices, measure a layer.

napari finds it by `napari.yaml`. Volumes are layers of three axes; scale and units go both ways.
"""
