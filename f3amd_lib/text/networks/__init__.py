"""Networks of ACMDM and MotionPCM."""
