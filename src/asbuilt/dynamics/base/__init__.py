"""Base parameters: which columns, the regrouping and why a parameter is not identifiable."""
