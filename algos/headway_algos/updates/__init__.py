"""How policies are improved from advantages: pure functions of explicit inputs."""
