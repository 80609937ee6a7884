"""terrasim: the ground under robots and vehicles."""
