"""Physical consistency of links and drives: bounds, priors, conic and entropic fits.

Both fits minimise torque error plus weight times distance from CAD over consistent bodies. The
conic one has a squared distance, is solved by Clarabel to a certified optimum, and bounds
quantities; estimators take it where CAD has next to no weight. The entropic one has the divergence
of pseudo-inertias, is solved by Newton's method for many factors at once, and is taken where
weights of CAD are compared.
"""
