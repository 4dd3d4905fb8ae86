"""Limits of errors of the evaluators; measured values are 10 to 1000 times smaller (`tests/accuracy.py`)."""

# Relative to the size of the cage; derivatives also divided by their size at a level, (2 lambda_2)^n.
POINT = 1e-13
DERIVATIVE = 1e-12
# Second derivatives, divided by (4 lambda_2)^n: two orders of rounding more than measured.
SECOND_DERIVATIVE = 1e-11
# In degrees.
NORMAL = 1e-9
# Relative to the principal curvatures, down to this level.
CURVATURE = 1e-8
CURVATURE_LEVELS = 40
# float32 rounds weights and sums: 2^-24 = 6e-8 a step, about 20 steps, over tangents of the size of the cage.
POINT_FLOAT32 = 1e-6
# In degrees, to valence 20. Tangents shrink as faces beside the point get narrow, so that less can be asked to valence
# 50, and nothing beyond. Processors add in different orders: up to 9e-5 to valence 20, and 1.3e-4 to 50.
NORMAL_FLOAT32 = 1e-4
NORMAL_FLOAT32_VALENCES, NORMAL_FLOAT32_NARROW = 20, 3e-4
