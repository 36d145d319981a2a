"""What people can choose, declared once: for the command line, the dialogs and files.

Importing it loads no array library, so that the command line can offer the options at once.
"""
