"""Output for a class: feedback, class page, exports, surveys."""
