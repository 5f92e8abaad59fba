"""What moves with what: joints, links and frames, joints held still, and joints that follow."""
