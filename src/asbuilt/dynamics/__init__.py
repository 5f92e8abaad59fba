"""What is true before any measurement: equations of motion, their regressor, drives and base parameters."""
