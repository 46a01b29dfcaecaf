"""Judge an alignment: its ambiguity by ties, its probabilities, and a verdict in one word."""

from slatprep.judge.ambiguity import measure_ambiguity as measure_ambiguity
from slatprep.judge.verdict import THRESHOLDS as THRESHOLDS
from slatprep.judge.verdict import contradicted as contradicted
from slatprep.judge.verdict import judge as judge
from slatprep.judge.verdict import merged as merged
from slatprep.judge.verdict import verdict_of as verdict_of
from slatprep.judge.verdict import voxel_confidence as voxel_confidence
