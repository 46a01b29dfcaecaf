"""The weights of the confidences; written by benchmarks/calibrate.py, not by hand."""

from slatprep.judge.evidence import FIGURES, VOXEL_FIGURES
from slatprep.judge.model import Figure, Logistic

SAME_OBJECT = Logistic(
    FIGURES,
    figures=(
        Figure(name="score_slat", weight=0.916227, usual=0.667719, low=0.104507, high=0.667719),
        Figure(name="score_pixieverse", weight=2.08763, usual=0.571646, low=0.10181, high=0.571646),
        Figure(name="score_similarity", weight=4.2361, usual=0.499648, low=0.137128, high=0.499648),
        Figure(name="within_1", weight=1.35893, usual=0.64658, low=0.124, high=0.64658),
        Figure(name="within_2", weight=1.98635, usual=0.80292, low=0.215, high=0.80292),
        Figure(name="within_2", weight=6.26693, usual=0.967487, low=0.80292, high=1.0),
        Figure(name="within_3", weight=2.50067, usual=0.8639, low=0.283, high=0.8639),
        Figure(name="within_3", weight=12.6428, usual=0.981072, low=0.8639, high=1.0),
        Figure(name="moved", weight=-0.452633, usual=0.801156, low=0.0, high=3.65839),
        Figure(name="moved", weight=-0.371832, usual=3.65839, low=3.65839, high=9.8977),
        Figure(name="moved_most", weight=-0.144762, usual=2.12262, low=0.0, high=9.79583),
        Figure(name="moved_most", weight=-0.120429, usual=9.79583, low=9.79583, high=21.8642),
        Figure(name="bending", weight=-108.183, usual=0.00414895, low=0.0, high=0.0149275),
        Figure(name="bending", weight=-218.429, usual=0.0149275, low=0.0149275, high=0.0280479),
        Figure(name="stretch", weight=-2.2594, usual=0.0479724, low=0.0, high=0.258076),
        Figure(name="stretch", weight=-1.0973, usual=0.258076, low=0.258076, high=0.488969),
        Figure(name="scale", weight=-3.05524, usual=0.0786052, low=0.0, high=0.43984),
        Figure(name="offset", weight=-0.991267, usual=0.141679, low=0.0, high=0.593602),
        Figure(name="offset", weight=-2.26019, usual=0.593602, low=0.593602, high=1.71185),
        Figure(name="fitness", weight=5.21183, usual=0.33727, low=0.0602728, high=0.33727),
        Figure(
            name="fitness_backward", weight=4.15386, usual=0.323867, low=0.0354841, high=0.323867
        ),
        Figure(name="valid_share", weight=2.00412, usual=0.922951, low=0.22023, high=0.922951),
        Figure(name="valid_share", weight=18.8017, usual=0.993057, low=0.922951, high=1.0),
        Figure(name="distance", weight=-2.46025, usual=0.536375, low=0.0, high=0.967307),
        Figure(name="distance", weight=-0.549053, usual=0.967307, low=0.967307, high=4.13225),
        Figure(name="depth", weight=-2.01679, usual=0.187323, low=0.0795556, high=0.307689),
        Figure(
            name="directions_near", weight=-0.438056, usual=0.384901, low=0.384901, high=2.95768
        ),
        Figure(
            name="directions_middle", weight=-0.279184, usual=0.686972, low=0.686972, high=3.91642
        ),
        Figure(name="directions_worst", weight=-0.015418, usual=0.301455, low=0.0, high=0.697764),
        Figure(name="directions_worst", weight=-0.629666, usual=0.697764, low=0.697764, high=4.0),
        Figure(name="blocks_near", weight=0.97041, usual=0.42, low=0.017, high=0.42),
        Figure(name="blocks_middle", weight=1.85049, usual=0.7188, low=0.09, high=0.7188),
        Figure(name="blocks_middle", weight=0.951935, usual=0.947462, low=0.7188, high=1.0),
        Figure(name="blocks_far", weight=2.28628, usual=0.81948, low=0.183, high=0.81948),
        Figure(name="blocks_far", weight=5.60068, usual=0.970912, low=0.81948, high=1.0),
        Figure(name="slat_within_half", weight=0.0709074, usual=0.45432, low=0.052, high=0.45432),
        Figure(name="slat_within_1", weight=0.791449, usual=0.702, low=0.086, high=0.702),
        Figure(name="slat_within_15", weight=1.45142, usual=0.79232, low=0.108, high=0.79232),
        Figure(name="slat_within_15", weight=3.16648, usual=0.963068, low=0.79232, high=1.0),
        Figure(
            name="pixieverse_within_half", weight=3.03668, usual=0.36116, low=0.046, high=0.36116
        ),
        Figure(name="pixieverse_within_1", weight=1.9881, usual=0.5838, low=0.078, high=0.5838),
        Figure(name="pixieverse_within_15", weight=2.34784, usual=0.67916, low=0.11, high=0.67916),
        Figure(name="pixieverse_within_15", weight=0.189435, usual=0.936826, low=0.67916, high=1.0),
    ),
    intercept=9.46423,
    curve=(),
)
"""Whether both sides show the same object."""

PLACEMENT = Logistic(
    FIGURES,
    figures=(
        Figure(name="margin", weight=28.8801, usual=0.172459, low=0.03, high=0.3),
        Figure(name="clear_by", weight=0.316649, usual=2.28647, low=-1.57251, high=6.54861),
        Figure(name="ties", weight=-1.95076, usual=0.0295344, low=0.0, high=1.79176),
    ),
    intercept=6.30687,
    curve=(),
)
"""Whether a placement is right, of the same object."""

VOXEL = Logistic(
    VOXEL_FIGURES,
    figures=(
        Figure(name="others_1", weight=-3.23411, usual=0.0199782, low=0.0, high=0.545455),
        Figure(name="others_2", weight=-2.76662, usual=0.0283664, low=0.0, high=0.583333),
        Figure(name="others_4", weight=-1.17634, usual=0.0778409, low=0.0, high=0.75),
        Figure(name="others_7", weight=-0.421128, usual=0.166304, low=0.0, high=1.0),
        Figure(name="distance", weight=-0.716472, usual=0.575057, low=0.0, high=2.8557),
        Figure(name="depth", weight=-0.762975, usual=0.228385, low=0.0, high=0.5),
        Figure(name="moved", weight=-0.100273, usual=1.12623, low=0.0, high=12.3478),
        Figure(name="asset_unsure", weight=-0.283886, usual=-3.00036, low=-6.21311, high=6.90675),
        Figure(name="asset_rough", weight=-10.6206, usual=0.203175, low=0.0867757, high=0.383063),
        Figure(name="asset_distance", weight=-3.37576, usual=0.576679, low=0.0, high=1.37254),
        Figure(name="asset_moved", weight=-0.13901, usual=1.1255, low=0.0, high=8.85517),
    ),
    intercept=3.87822,
    curve=(
        (-2.438, 0.29619),
        (-1.1382, 0.38577),
        (-0.71247, 0.39566),
        (-0.41325, 0.44585),
        (-0.10649, 0.48495),
        (0.19206, 0.51334),
        (0.48575, 0.5811),
        (0.79282, 0.65517),
        (1.088, 0.72624),
        (1.3954, 0.74055),
        (1.6896, 0.76299),
        (1.9892, 0.81929),
        (2.286, 0.8636),
        (2.5938, 0.9082),
        (2.8932, 0.94998),
        (3.1834, 0.96042),
        (3.4863, 0.96042),
        (3.7937, 0.97205),
        (4.0891, 0.9824),
        (4.389, 0.99104),
        (4.6864, 0.99582),
        (4.9884, 0.99779),
        (5.2884, 0.99932),
        (5.584, 0.99975),
        (5.8828, 0.99988),
        (6.1621, 0.99988),
        (6.4399, 0.99988),
        (6.7625, 0.99988),
        (7.0614, 0.99988),
        (7.3736, 0.99988),
        (7.6995, 0.99988),
        (7.9971, 1.0),
        (8.3137, 1.0),
        (8.5642, 1.0),
        (8.8226, 1.0),
    ),
)
"""Whether the class of a voxel is right."""
