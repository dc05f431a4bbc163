"""What is integrated: the contract (``base``), mechanisms on Pinocchio, and their algebra."""
