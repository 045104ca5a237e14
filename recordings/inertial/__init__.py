"""Up from accelerometer and gyroscope: samples, their integration in blocks, the filter, and the tilts."""
