"""What of a body each camera sees: visibility, occlusion, limbs that part from the rest."""
