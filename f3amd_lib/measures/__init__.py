"""The measures of motion quality, and the protocol by which motion is measured."""
