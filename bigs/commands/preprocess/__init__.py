"""`bigs preprocess`: what a user asks for, the steps in order, and a picture of each."""
