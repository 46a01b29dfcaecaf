"""The weights of the confidences; written by benchmarks/calibrate.py, not by hand."""

from slatprep.judge.evidence import FIGURES, VOXEL_FIGURES
from slatprep.judge.model import Figure, Logistic

SAME_OBJECT = Logistic(
    FIGURES,
    figures=(
        Figure(name="score_slat", weight=1.08252, usual=0.664224, low=0.144329, high=0.664224),
        Figure(
            name="score_pixieverse", weight=0.160535, usual=0.574382, low=0.138036, high=0.574382
        ),
        Figure(name="score_similarity", weight=4.38441, usual=0.50471, low=0.139058, high=0.50471),
        Figure(name="within_1", weight=1.37569, usual=0.64436, low=0.124, high=0.64436),
        Figure(name="within_2", weight=2.38939, usual=0.79332, low=0.22358, high=0.79332),
        Figure(name="within_2", weight=4.29563, usual=0.967229, low=0.79332, high=1.0),
        Figure(name="within_3", weight=2.04431, usual=0.86618, low=0.29043, high=0.86618),
        Figure(name="within_3", weight=11.8316, usual=0.981061, low=0.86618, high=1.0),
        Figure(name="moved", weight=-0.460148, usual=0.78527, low=0.0, high=3.66576),
        Figure(name="moved", weight=-0.455215, usual=3.66576, low=3.66576, high=9.5009),
        Figure(name="moved_most", weight=-0.144923, usual=2.05798, low=0.0, high=9.89446),
        Figure(name="moved_most", weight=-0.132798, usual=9.89446, low=9.89446, high=21.8647),
        Figure(name="bending", weight=-89.8081, usual=0.0039849, low=0.0, high=0.0152729),
        Figure(name="bending", weight=-270.362, usual=0.0152729, low=0.0152729, high=0.0279044),
        Figure(name="stretch", weight=-2.6904, usual=0.0444965, low=0.0, high=0.244854),
        Figure(name="stretch", weight=-0.628907, usual=0.244854, low=0.244854, high=0.482535),
        Figure(name="scale", weight=-1.1901, usual=0.0795871, low=0.0, high=0.443022),
        Figure(name="offset", weight=-0.455233, usual=0.142095, low=0.0, high=0.581971),
        Figure(name="offset", weight=-2.26967, usual=0.581971, low=0.581971, high=1.76169),
        Figure(name="fitness", weight=5.17018, usual=0.338497, low=0.0571056, high=0.338497),
        Figure(name="fitness", weight=0.240461, usual=0.730016, low=0.338497, high=1.0),
        Figure(name="fitness_backward", weight=5.20492, usual=0.31354, low=0.0450347, high=0.31354),
        Figure(name="valid_share", weight=2.21915, usual=0.922627, low=0.283995, high=0.922627),
        Figure(name="valid_share", weight=19.212, usual=0.992845, low=0.922627, high=1.0),
        Figure(name="distance", weight=-3.01765, usual=0.53773, low=0.0, high=0.968599),
        Figure(name="distance", weight=-0.6245, usual=0.968599, low=0.968599, high=3.79604),
        Figure(name="depth", weight=-3.63845, usual=0.188107, low=0.0809629, high=0.30779),
        Figure(name="ground", weight=-0.485995, usual=0.248485, low=0.0, high=1.0),
        Figure(
            name="directions_near", weight=-0.528434, usual=0.389147, low=0.389147, high=2.83595
        ),
        Figure(
            name="directions_middle", weight=-0.287436, usual=0.747037, low=0.747037, high=3.79068
        ),
        Figure(name="directions_worst", weight=-0.664386, usual=0.742486, low=0.742486, high=4.0),
        Figure(name="blocks_near", weight=1.88612, usual=0.40426, low=0.01781, high=0.40426),
        Figure(name="blocks_middle", weight=2.68579, usual=0.71218, low=0.09862, high=0.71218),
        Figure(name="blocks_far", weight=2.47213, usual=0.81708, low=0.18577, high=0.81708),
        Figure(name="blocks_far", weight=4.56974, usual=0.970771, low=0.81708, high=1.0),
        Figure(name="slat_within_half", weight=0.361008, usual=0.448, low=0.06162, high=0.448),
        Figure(name="slat_within_1", weight=0.957501, usual=0.702, low=0.10924, high=0.702),
        Figure(name="slat_within_15", weight=1.54348, usual=0.79072, low=0.156, high=0.79072),
        Figure(name="slat_within_15", weight=4.69301, usual=0.961327, low=0.79072, high=1.0),
        Figure(name="pixieverse_within_1", weight=0.721796, usual=0.588, low=0.09934, high=0.588),
        Figure(
            name="pixieverse_within_15", weight=1.45352, usual=0.69544, low=0.14324, high=0.69544
        ),
        Figure(name="pixieverse_within_15", weight=0.522498, usual=0.936594, low=0.69544, high=1.0),
    ),
    intercept=9.43271,
    curve=(),
)
"""Whether both sides show the same object."""

PLACEMENT = Logistic(
    FIGURES,
    figures=(
        Figure(name="margin", weight=27.5511, usual=0.173063, low=0.03, high=0.3),
        Figure(name="clear_by", weight=0.937006, usual=2.63558, low=-0.0847931, high=7.07301),
        Figure(name="ties", weight=-0.4486, usual=0.0328232, low=0.0, high=1.79176),
    ),
    intercept=5.92499,
    curve=(),
)
"""Whether a placement is right, of the same object."""

VOXEL = Logistic(
    VOXEL_FIGURES,
    figures=(
        Figure(name="others_1", weight=-3.48408, usual=0.0195133, low=0.0, high=0.545455),
        Figure(name="others_2", weight=-2.57891, usual=0.0277359, low=0.0, high=0.583333),
        Figure(name="others_4", weight=-1.09398, usual=0.0767462, low=0.0, high=0.75),
        Figure(name="others_7", weight=-0.284071, usual=0.165368, low=0.0, high=1.0),
        Figure(name="others_7_rough", weight=-0.0307472, usual=0.0337421, low=0.0, high=0.290392),
        Figure(
            name="others_7_unsure", weight=-0.00113491, usual=-0.454444, low=-5.17759, high=6.14443
        ),
        Figure(name="distance", weight=-0.7238, usual=0.576629, low=0.0, high=2.86125),
        Figure(name="depth", weight=-0.959405, usual=0.230215, low=0.0, high=0.5),
        Figure(name="moved", weight=-0.0876976, usual=1.13125, low=0.0, high=12.3938),
        Figure(name="asset_unsure", weight=-0.293495, usual=-2.78773, low=-6.21311, high=6.90675),
        Figure(name="asset_rough", weight=-10.4418, usual=0.204657, low=0.0845637, high=0.384397),
        Figure(name="asset_distance", weight=-3.18224, usual=0.5785, low=0.0, high=1.34995),
        Figure(name="asset_moved", weight=-0.194026, usual=1.13425, low=0.0, high=9.09305),
    ),
    intercept=3.91398,
    curve=(
        (-2.351, 0.32044),
        (-1.0779, 0.38815),
        (-0.46988, 0.47172),
        (-0.065017, 0.47172),
        (0.22637, 0.53313),
        (0.53882, 0.57797),
        (0.8351, 0.6115),
        (1.1304, 0.691),
        (1.4292, 0.70942),
        (1.7301, 0.78207),
        (2.033, 0.84646),
        (2.3306, 0.87361),
        (2.6408, 0.92531),
        (2.9374, 0.95036),
        (3.2311, 0.96621),
        (3.5311, 0.97041),
        (3.8348, 0.97317),
        (4.1319, 0.9804),
        (4.4288, 0.99211),
        (4.7297, 0.99639),
        (5.0331, 0.9985),
        (5.3329, 0.99922),
        (5.627, 0.99975),
        (5.9296, 0.99988),
        (6.2162, 0.99991),
        (6.4868, 0.99991),
        (6.8006, 0.99991),
        (7.0975, 0.99991),
        (7.4375, 0.99991),
        (7.7434, 0.99991),
        (8.0317, 1.0),
        (8.3519, 1.0),
        (8.6274, 1.0),
        (8.8379, 1.0),
    ),
)
"""Whether the class of a voxel is right."""
