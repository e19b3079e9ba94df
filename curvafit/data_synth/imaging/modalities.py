"""The presets, as data. Orders of magnitude, not calibrations: what each number rests on stands beside it.

Widths of optical point-spread functions: 0.2 λ / NA across (Zhang, Zerubia and Olivo-Marin, Appl. Opt. 46, 2007) and
0.37 λ / (n - √(n² - NA²)) along the axis, as deviations; a specimen's aberrations make them up to twice as wide.
"""

from curvafit.core.checks import plain_name, quoted
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.imaging.parameters import (
    Contrast,
    Detector,
    Illumination,
    Imaging,
    Noise,
    Optics,
    Specimen,
)

CONFOCAL = Modality(
    "confocal",
    "A fixed, stained specimen under a dry lens of NA 0.8, λ 0.52 µm",
    0.5,
    Imaging(
        unit="um",
        spacing=(1.0, 0.5, 0.5),
        contrast=Contrast(
            background_texture=0.4,  # autofluorescence and unbound dye, cell by cell
            background_length=3.0,
            foreground_length=3.0,  # patches of antibody
        ),
        specimen=Specimen(
            dropout_length=5.0,
            dropout_loss=0.85,
            clutter_radius=0.6,  # precipitate of dye, of a micrometre
            clutter_height=0.7,
        ),
        illumination=Illumination(
            bias_length=60.0,  # vignetting: of the field's size
        ),
        noise=Noise(
            gaussian=1.5,  # a photomultiplier's amplifier, 8 bits
        ),
        detector=Detector(
            offset=6.0,
            ceiling=255.0,
        ),
    ),
    {
        "contrast.background": (1.0, 6.0),  # photons a pixel: tens at the structure for a dwell of a microsecond
        "contrast.foreground": (15.0, 60.0),
        "contrast.foreground_texture": (0.15, 0.4),
        "optics.blur": ((0.7, 0.15, 0.15), (1.3, 0.3, 0.3)),  # 0.13 and 0.72 µm by the formulas
        "optics.growth": (0.0, 0.01),  # mismatched index: some ten percent wider over 10 to 50 µm
        "optics.attenuation": (0.0, 0.012),  # light halves over 60 µm and more of uncleared tissue
        "illumination.bias": (0.05, 0.25),
        "specimen.dropout": (0.0, 0.15),
        "specimen.clutter": (2e-5, 3e-4),
        "detector.gain": (2.0, 4.0),
    },
)

TWO_PHOTON = Modality(
    "two-photon",
    "Dyed blood in living cortex: λ 0.9 µm, NA 1 underfilled to 0.6 (widths: Zipfel, Williams and Webb 2003)",
    0.8,
    Imaging(
        unit="um",
        spacing=(2.4, 0.8, 0.8),  # steps of 2 to 5 µm are usual
        contrast=Contrast(
            background_texture=0.5,
            background_length=8.0,
            foreground_length=6.0,  # columns of unstained red cells
        ),
        specimen=Specimen(
            dropout_length=8.0,
            dropout_loss=0.8,
            clutter_radius=1.2,
            clutter_height=0.6,
        ),
        illumination=Illumination(
            bias_length=150.0,
        ),
        noise=Noise(
            gaussian=12.0,
        ),
        detector=Detector(
            offset=40.0,
            ceiling=4095.0,  # 12 bits
        ),
    ),
    {
        "contrast.background": (0.3, 1.5),  # a few photons a dwell, background near none
        "contrast.foreground": (8.0, 40.0),
        "contrast.foreground_texture": (0.25, 0.6),
        "optics.blur": ((1.3, 0.3, 0.3), (2.4, 0.6, 0.6)),  # 0.25 and 1.6 µm at NA 0.6, wider in tissue
        "optics.growth": (0.0, 0.004),  # resolution is nearly kept to hundreds of micrometres
        "optics.attenuation": (0.005, 0.015),  # exp(-2 z / ℓ) for scattering lengths ℓ of 130 to 400 µm
        "illumination.bias": (0.05, 0.3),
        "specimen.dropout": (0.0, 0.2),
        "specimen.clutter": (1e-6, 3e-5),
        "detector.gain": (40.0, 90.0),
    },
)

LIGHT_SHEET = Modality(
    "light-sheet",
    "A cleared organ, sheet of 6 µm (full width at half maximum), detection at NA 0.3 on an sCMOS camera",
    2.0,
    Imaging(
        unit="um",
        spacing=(4.0, 2.0, 2.0),
        contrast=Contrast(
            background_texture=0.25,  # autofluorescent tissue, never dark
            background_length=15.0,
            foreground_length=15.0,
        ),
        specimen=Specimen(
            dropout_length=20.0,  # where antibodies did not reach
            dropout_loss=0.9,
            clutter_radius=3.0,
            clutter_height=0.8,
        ),
        illumination=Illumination(
            bias_length=250.0,  # the sheet is thinnest in the middle
            stripe_width=5.0,  # shadows of what the sheet meets, some micrometres wide
        ),
        noise=Noise(
            gaussian=3.5,  # 1.6 e⁻
        ),
        detector=Detector(
            gain=2.2,  # counts a photoelectron of a camera of 0.46 e⁻ a count
            offset=100.0,
            ceiling=65535.0,
        ),
    ),
    {
        "contrast.background": (60.0, 200.0),
        "contrast.foreground": (250.0, 900.0),
        "contrast.foreground_texture": (0.2, 0.5),
        "optics.blur": (
            (2.2, 0.7, 0.7),
            (3.5, 1.4, 1.4),
        ),  # sheet 6 µm / 2.35; across 0.37 µm by the formula, in clearing worse
        "optics.growth": (0.0, 0.002),
        "optics.attenuation": (0.0, 0.002),
        "illumination.bias": (0.1, 0.35),
        "illumination.stripes": (0.03, 0.15),
        "specimen.dropout": (0.0, 0.15),
        "specimen.clutter": (3e-7, 6e-6),
    },
)

MICRO_CT = Modality(
    "micro-ct",
    "Trabecular bone at 20 µm, reconstructed and scaled to 8 bits",
    20.0,
    Imaging(
        unit="um",
        spacing=(20.0, 20.0, 20.0),
        thickness=20.0,
        contrast=Contrast(
            background_texture=0.15,  # marrow and water
            background_length=120.0,
            foreground_length=80.0,  # mineral by packets of a tenth of a millimetre
        ),
        specimen=Specimen(
            dropout_length=100.0,
            clutter_radius=30.0,
        ),
        illumination=Illumination(
            bias_length=1500.0,  # cupping by beam hardening
        ),
        noise=Noise(
            width=(0.6, 0.7, 0.7),  # what the reconstruction filter leaves
        ),
        detector=Detector(
            ring_width=15.0,  # less than a detector's pixel apart
            ceiling=255.0,
        ),
    ),
    {
        "contrast.background": (30.0, 60.0),  # grey values
        "contrast.foreground": (110.0, 170.0),
        "contrast.foreground_texture": (0.05, 0.12),
        "optics.blur": ((10.0, 10.0, 10.0), (18.0, 18.0, 18.0)),  # the X-ray spot: a resolution of 1.5 to 2 voxels
        "illumination.bias": (0.02, 0.1),
        "detector.rings": (0.02, 0.08),
        "noise.gaussian": (8.0, 22.0),  # contrast to noise of 5 to 12
    },
)

MRA = Modality(
    "mra",
    "Time-of-flight angiography at 3 T: slices of 0.6 mm, interpolated to 0.3 mm in the plane",
    0.3,
    Imaging(
        unit="mm",
        spacing=(0.6, 0.3, 0.3),
        thickness=0.6,
        contrast=Contrast(
            background_texture=0.2,  # grey and white matter, liquor
            background_length=3.0,
            foreground_length=2.0,
        ),
        specimen=Specimen(
            dropout_length=2.5,  # slow or turbulent flow
            dropout_loss=0.8,
            clutter_radius=0.5,
        ),
        optics=Optics(
            blur=(0.2, 0.25, 0.25),  # acquired at 0.6 mm, windowed
        ),
        illumination=Illumination(
            bias_length=30.0,  # the coil's reach
        ),
        noise=Noise(
            width=(0.0, 0.6, 0.6),  # interpolation by zero filling
        ),
        detector=Detector(
            ceiling=4095.0,
        ),
    ),
    {
        "contrast.background": (90.0, 160.0),
        "contrast.foreground": (260.0, 420.0),  # inflow: two to three times the tissue
        "contrast.foreground_texture": (0.05, 0.2),
        "illumination.bias": (0.1, 0.35),
        "specimen.dropout": (0.0, 0.15),
        "noise.rician": (8.0, 25.0),  # signal to noise of 5 to 15 in tissue
    },
)

EM_MEMBRANE = Modality(
    "em-membrane",
    "Stained pairs of membranes, dark, in neuropil by focused ion beam: voxels of 5 nm",
    2.5,
    Imaging(
        unit="nm",
        spacing=(5.0, 5.0, 5.0),
        thickness=5.0,
        contrast=Contrast(
            background=165.0,
            background_length=8.0,  # ribosomes and filaments
            foreground_texture=0.1,
            foreground_length=15.0,
        ),
        specimen=Specimen(
            dropout_length=40.0,  # membranes that were poorly stained
            dropout_loss=0.6,
            clutter_radius=8.0,  # vesicles of 30 to 50 nm, granules
        ),
        illumination=Illumination(
            bias_length=600.0,  # charging
            stripe_width=6.0,  # curtains of the ion beam
        ),
        noise=Noise(
            width=(0.0, 0.5, 0.5),
        ),
        detector=Detector(
            ceiling=255.0,
        ),
    ),
    {
        "contrast.background_texture": (0.08, 0.18),
        "contrast.foreground": (60.0, 100.0),
        "optics.blur": ((3.0, 2.0, 2.0), (5.0, 4.0, 4.0)),  # electrons come from some nanometres around the beam
        "illumination.bias": (0.02, 0.12),
        "illumination.stripes": (0.005, 0.03),
        "specimen.dropout": (0.0, 0.2),
        "specimen.clutter": (3e-7, 3e-6),
        "specimen.clutter_height": (0.4, 0.9),
        "noise.gaussian": (8.0, 20.0),
    },
)

#: By name, as at the command line.
MODALITIES: dict[str, Modality] = {
    each.name: each for each in (CONFOCAL, TWO_PHOTON, LIGHT_SHEET, MICRO_CT, MRA, EM_MEMBRANE)
}


def modality(name: str) -> Modality:
    """Return the preset of a name; capitals, spaces and underscores do not count: `two-photon` is `Two_Photon`.

    Raises
    ------
    ValueError
        If there is no such preset.
    """
    plain = plain_name(str(name))
    if plain not in MODALITIES:
        raise ValueError(f"expected a modality among {', '.join(MODALITIES)}, got {quoted(name)}")
    return MODALITIES[plain]
