"""What every sensor is made with: its two bases, gradient policies, checks of arguments, numbers of pixels."""
