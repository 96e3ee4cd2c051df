"""Methods that several stages share: noise, peaks, levels and transforms, least squares."""
