"""What a class is shown: feedback, the class page, exports, surveys."""
