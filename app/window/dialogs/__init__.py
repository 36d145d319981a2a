"""Dialogs: questions, forms and messages."""
