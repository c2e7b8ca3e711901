"""Root paths, autoregressive rollout and the measures of motion quality."""
