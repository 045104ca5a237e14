"""From a rectified pair to disparity (paper section 3.1): semi-global matching, pyramid, left-right check."""
