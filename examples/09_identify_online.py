"""Follow a change of load on line: the estimate is renewed with every sample."""

import numpy as np

import asbuilt

model = asbuilt.load_robot("scara")
base = asbuilt.find_base_parameters(model)
box = asbuilt.LinkInertia.from_com(2.0, [0.0, 0.0, 0.05], 0.003 * np.eye(3))
motion = asbuilt.random_fourier(model, rng=1, duration=20.0, n_harmonics=8)
empty = asbuilt.simulate_recording(model, motion, rate=100.0)
loaded = asbuilt.simulate_recording(model, motion, rate=100.0, tool=box)
states = motion.sample(100.0)

k = base.names.index("m3")
line = asbuilt.RecursiveIdentification(model, base, forgetting=0.99)
for recording in (empty, loaded):
    for q, qd, qdd, tau in zip(states.q, states.qd, states.qdd, recording.tau, strict=True):
        estimate = line.update(q, qd, qdd, tau)
    print(f"rank {estimate.rank} of {base.n_base}, {estimate.n_effective:.0f} samples count")
    print(f"  {base.names[k]} = {estimate.beta[k]:.3f} +/- {estimate.std_errors[k]:.1g}")

carried = estimate.beta[k] - base.values(model.parameters)[k]
print(f"the load is {carried:.3f} kg")
assert abs(carried - box.mass) < 0.02
