"""What an .fmu says of itself: the archive, judged and unpacked, and its modelDescription.xml."""
