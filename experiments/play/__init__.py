"""A page in the browser: watch the robot imagine, type a reward, see it done."""
