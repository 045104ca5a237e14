"""ROS 2 messages: their CDR codec, and the conversion to and from the types of `stages.data`."""
