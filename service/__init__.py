"""The service: configuration, executors, the training loop, the front door for Python and the command line."""
