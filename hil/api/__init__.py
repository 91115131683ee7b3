"""What programs are written against: scenarios run, laws designed, studies made, without the command line."""
