"""The method: plain callables over the data types of `stages.data`."""
