"""What a log contains, and what a run needs beside it: for `roverflow info`."""
