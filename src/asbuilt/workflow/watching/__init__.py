"""Study of a log for external torque, contact and fault."""
