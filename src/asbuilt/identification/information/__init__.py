"""Square-root information: what recordings say about the parameters, in triangular factors."""
