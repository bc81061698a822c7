"""P3: closed chains, their equations and mobility."""
