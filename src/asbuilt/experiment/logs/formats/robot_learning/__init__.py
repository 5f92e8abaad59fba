"""Log formats of robot learning."""
