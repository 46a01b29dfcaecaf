"""What the confidences weigh; written by benchmarks/calibrate.py, not by hand."""

from slatprep.judge.model import Figure, Logistic

PLACEMENT = Logistic(
    figures=(
        Figure(name="score_slat", weight=1.87123, usual=0.859761, low=0.168965, high=1.0),
        Figure(name="score_pixieverse", weight=0.932759, usual=0.825534, low=0.138522, high=1.0),
        Figure(name="score_similarity", weight=0.793449, usual=0.766409, low=0.160365, high=1.0),
        Figure(name="within_1", weight=2.6712, usual=0.907318, low=0.12542, high=1.0),
        Figure(name="within_2", weight=3.0004, usual=0.960247, low=0.21832, high=1.0),
        Figure(name="within_3", weight=2.33286, usual=0.970206, low=0.3026, high=1.0),
        Figure(name="moved", weight=-0.0628617, usual=1.00521, low=0.0, high=7.97599),
        Figure(name="moved_most", weight=-0.0150982, usual=2.60465, low=0.0, high=21.3583),
        Figure(name="bending", weight=-73.4487, usual=0.00439077, low=0.0, high=0.0308953),
        Figure(name="stretch", weight=0.0, usual=0.0446034, low=0.0, high=0.309048),
        Figure(name="scale", weight=-1.20162, usual=0.0501993, low=0.0, high=0.498895),
        Figure(name="offset", weight=0.0, usual=0.121538, low=0.0, high=1.20962),
        Figure(name="margin", weight=17.9786, usual=0.188832, low=0.0, high=0.3),
        Figure(name="ties", weight=-1.02152, usual=0.00407734, low=0.0, high=3.21888),
        Figure(name="fitness", weight=0.0, usual=0.73375, low=0.0881038, high=1.0),
        Figure(name="fitness_backward", weight=0.0, usual=0.771529, low=0.0908306, high=1.0),
        Figure(name="valid_share", weight=2.48524, usual=0.987031, low=0.287682, high=1.0),
        Figure(name="distance", weight=-0.57706, usual=0.540324, low=0.0, high=3.77811),
        Figure(name="depth", weight=-13.9476, usual=0.189602, low=0.114022, high=0.457345),
        Figure(name="alike", weight=0.0, usual=0.305882, low=0.0, high=1.0),
    ),
    intercept=5.99135,
    curve=(),
)
"""Whether a placement is right."""

VOXEL = Logistic(
    figures=(
        Figure(name="others_1", weight=-4.7134, usual=0.0130171, low=0.0, high=0.5),
        Figure(name="others_2", weight=-3.07295, usual=0.018553, low=0.0, high=0.538462),
        Figure(name="others_4", weight=-1.98247, usual=0.0560482, low=0.0, high=0.7),
        Figure(name="others_7", weight=-0.949702, usual=0.13052, low=0.0, high=1.0),
        Figure(name="others_1_rough", weight=0.0, usual=0.00258197, low=0.0, high=0.117245),
        Figure(name="others_2_rough", weight=0.0, usual=0.00368707, low=0.0, high=0.13229),
        Figure(name="others_4_rough", weight=-1.7046, usual=0.0110353, low=0.0, high=0.182938),
        Figure(name="others_7_rough", weight=-4.65779, usual=0.0254591, low=0.0, high=0.268839),
        Figure(name="others_1_unsure", weight=0.0, usual=-0.0518484, low=-2.49482, high=1.3002),
        Figure(name="others_2_unsure", weight=0.0, usual=-0.0741839, low=-2.7627, high=1.72669),
        Figure(
            name="others_4_unsure", weight=-0.0624641, usual=-0.229533, low=-3.83709, high=2.96004
        ),
        Figure(
            name="others_7_unsure", weight=-0.197973, usual=-0.538612, low=-5.45921, high=4.35423
        ),
        Figure(name="distance", weight=-0.826837, usual=0.546328, low=0.0, high=2.87239),
        Figure(name="depth", weight=-1.26305, usual=0.228928, low=0.0, high=0.5),
        Figure(name="moved", weight=-0.0524664, usual=1.01969, low=0.0, high=10.4844),
        Figure(name="asset_unsure", weight=-0.0837717, usual=-3.68811, low=-6.90675, high=6.90675),
        Figure(name="asset_rough", weight=-3.73329, usual=0.204287, low=0.109475, high=0.39234),
        Figure(name="asset_distance", weight=-1.83124, usual=0.548235, low=0.0, high=1.23833),
        Figure(name="asset_moved", weight=-0.0940182, usual=1.01633, low=0.0, high=6.62558),
    ),
    intercept=5.80425,
    curve=(
        (-0.061558, 0.6244),
        (1.1518, 0.72778),
        (1.7719, 0.81165),
        (2.4114, 0.87488),
        (3.048, 0.90888),
        (3.678, 0.95548),
        (4.3099, 0.98185),
        (4.8203, 0.992),
        (5.2026, 0.99653),
        (5.5169, 0.99806),
        (5.7658, 0.99888),
        (5.9593, 0.99909),
        (6.1182, 0.99909),
        (6.2527, 0.99948),
        (6.3704, 0.99948),
        (6.4748, 0.99952),
        (6.5712, 0.99962),
        (6.6565, 0.99979),
        (6.7389, 0.99979),
        (6.8204, 0.9998),
        (6.9062, 0.9998),
        (7.0038, 0.99992),
        (7.1504, 0.99992),
        (8.2156, 1.0),
    ),
)
"""Whether the class of a voxel is right."""
