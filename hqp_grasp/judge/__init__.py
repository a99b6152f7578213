"""Does a grasp hold? Simulated tests that know the truth, and that no controller reads."""
