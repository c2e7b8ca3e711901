"""Motion from text: ACMDM and MotionPCM, with the judge of both."""
