"""What an .fmu holds: the archive, checked and unpacked, and its modelDescription.xml."""
