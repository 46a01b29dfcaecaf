"""A decoder that is trained in no time; nothing but time depends on the size of one."""

from slatprep.learn import decoder

TINY = "tiny"

decoder.SIZES[TINY] = decoder.DecoderSize(24, 2, 2)
