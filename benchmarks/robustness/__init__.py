"""What kinefit makes of wrong, damaged and hostile inputs."""
