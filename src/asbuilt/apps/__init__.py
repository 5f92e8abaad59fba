"""What can be taken away: each folder is an application with library, commands and pages."""
