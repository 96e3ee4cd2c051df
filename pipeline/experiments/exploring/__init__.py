"""The bench that investigates itself: record, identify, doubt, choose, again."""
