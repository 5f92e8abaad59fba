"""Write the controller programs that run a motion, for each robot that a format can move."""

import asbuilt

written = 0
for robot in ("kuka-iiwa7-r800", "franka-panda", "ur10e", "scara"):
    motion = asbuilt.random_fourier(asbuilt.load_robot(robot), rng=1, duration=10.0)
    for form in ("sunrise", "fri", "franka", "urscript", "ros2", "csv"):
        try:
            program = asbuilt.make_program(robot, motion, form, name="run 1")
        except asbuilt.AsbuiltError as refusal:
            print(f"{robot:16} {form:9} {refusal.message.split(';')[0]}")
            continue
        written += 1
        print(f"{robot:16} {form:9} {', '.join(file.name for file in program)}")
assert written >= 12
