"""Arguments of commands, generated from option classes."""
